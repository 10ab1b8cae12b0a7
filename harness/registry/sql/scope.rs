//! The columns that a place of a query may name, and where they stand.

use harness_tables::schema::Kind;
use polars::prelude::*;
use sqlparser::ast::Ident;

/// What a value is.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Type {
    /// What `null` alone is.
    Null,
    Flag,
    Integer,
    /// A real number of 32 bits, as some columns hold it. Whatever is computed of it has 64.
    Single,
    Real,
    Text,
    Bytes,
}

impl Type {
    /// What a column is, and what the frame holds it as.
    pub fn of(kind: Kind, held: Option<&DataType>) -> Self {
        match kind {
            Kind::Text => Type::Text,
            Kind::Integer => Type::Integer,
            Kind::Real if held == Some(&DataType::Float32) => Type::Single,
            Kind::Real => Type::Real,
            Kind::Flag => Type::Flag,
            Kind::Bytes => Type::Bytes,
        }
    }

    pub fn data_type(self) -> DataType {
        match self {
            Type::Null => DataType::Null,
            Type::Flag => DataType::Boolean,
            Type::Integer => DataType::Int64,
            Type::Single => DataType::Float32,
            Type::Real => DataType::Float64,
            Type::Text => DataType::String,
            Type::Bytes => DataType::Binary,
        }
    }

    /// As a message names it.
    pub fn name(self) -> &'static str {
        match self {
            Type::Null => "null",
            Type::Flag => "true or false",
            Type::Integer => "an integer",
            Type::Single | Type::Real => "a real number",
            Type::Text => "text",
            Type::Bytes => "bytes",
        }
    }

    pub fn is_number(self) -> bool {
        matches!(self, Type::Integer | Type::Single | Type::Real | Type::Null)
    }

    /// The type that holds values of both, if there is one.
    pub fn common(self, other: Type) -> Option<Type> {
        match (self, other) {
            (a, b) if a == b => Some(a),
            (Type::Null, other) | (other, Type::Null) => Some(other),
            (a, b) if a.is_number() && b.is_number() => Some(Type::Real),
            _ => None,
        }
    }
}

/// A column of a table, of a join or of a subquery.
#[derive(Debug, Clone)]
pub struct Column {
    /// The table's name in the query; none for what USING merges.
    pub table: Option<String>,
    pub name: String,
    /// Its name in the frame, which no other column has.
    pub id: String,
    pub kind: Type,
    /// Whether USING merged it into another column: only `table.name` finds it.
    pub merged: bool,
}

/// What a table, a join or a query gives.
#[derive(Clone)]
pub struct Relation {
    pub frame: LazyFrame,
    pub columns: Vec<Column>,
    /// Rows, at most, where a join made them; none where they are those of tables.
    pub rows: Option<u64>,
    /// How many times tables are read for it.
    pub reads: usize,
}

impl Relation {
    /// The names of its tables.
    pub fn tables(&self) -> Vec<&str> {
        self.columns.iter().filter_map(|column| column.table.as_deref()).collect()
    }
}

/// Names in SQL are the same in upper and lower case.
pub fn same(a: &str, b: &str) -> bool {
    a.eq_ignore_ascii_case(b)
}

/// Why a name stands for no column.
pub enum Unresolved {
    /// There is none of this name.
    Unknown(String),
    /// Several columns have it.
    Ambiguous(String),
}

/// The column that `path` names: `column` or `table.column`.
pub fn resolve<'a>(columns: &'a [Column], path: &[Ident]) -> Result<&'a Column, Unresolved> {
    let (table, name) = match path {
        [name] => (None, name.value.as_str()),
        [table, name] => (Some(table.value.as_str()), name.value.as_str()),
        _ => {
            let path: Vec<&str> = path.iter().map(|part| part.value.as_str()).collect();
            return Err(Unresolved::Unknown(format!(
                "'{}' is no column; write table.column",
                path.join(".")
            )));
        }
    };
    let is_wanted = |column: &&Column| match table {
        None => !column.merged,
        Some(table) => column.table.as_deref().is_some_and(|found| same(found, table)),
    };
    let visible: Vec<&Column> = columns.iter().filter(is_wanted).collect();
    let found: Vec<&&Column> = visible.iter().filter(|column| same(&column.name, name)).collect();
    match (found.as_slice(), table) {
        ([column], _) => Ok(column),
        ([], Some(table)) if visible.is_empty() => Err(Unresolved::Unknown(unknown_table(columns, table))),
        ([], _) => Err(Unresolved::Unknown(unknown_column(&visible, name))),
        (several, None) => {
            let places: Vec<String> = several
                .iter()
                .filter_map(|column| Some(format!("{}.{}", column.table.as_ref()?, column.name)))
                .collect();
            let places = if places.is_empty() {
                "name them apart with AS".to_owned()
            } else {
                format!("write {}", places.join(" or "))
            };
            Err(Unresolved::Ambiguous(format!("'{name}' may be one of several columns; {places}")))
        }
        (_, Some(table)) => Err(Unresolved::Ambiguous(format!(
            "'{table}' has several columns '{name}'; name them apart with AS"
        ))),
    }
}

fn unknown_table(columns: &[Column], table: &str) -> String {
    let mut tables: Vec<&str> = columns.iter().filter_map(|column| column.table.as_deref()).collect();
    tables.dedup();
    format!("there is no table '{table}' in its FROM{}", choice(table, &tables))
}

fn unknown_column(columns: &[&Column], name: &str) -> String {
    let names: Vec<&str> = columns.iter().map(|column| column.name.as_str()).collect();
    format!("there is no column '{name}'{}", choice(name, &names))
}

/// What there is instead of `wanted`, the nearest first in line; the end of a sentence.
pub fn choice(wanted: &str, names: &[&str]) -> String {
    let wanted = wanted.to_lowercase();
    let distance = |name: &&&str| strsim::damerau_levenshtein(&wanted, &name.to_lowercase());
    let nearest = names.iter().min_by_key(distance).filter(|name| distance(name) <= 1 + wanted.len() / 4);
    let meant = nearest.map_or(String::new(), |name| format!("; did you mean '{name}'?"));
    match names {
        [] => meant,
        names if names.len() > 40 => format!("{meant}; DESCRIBE lists a table's columns"),
        names if meant.is_empty() => format!("; there are {}", names.join(", ")),
        names => format!("{meant} There are {}", names.join(", ")),
    }
}
