//! Types, columns and relations of a query, and how names are resolved to columns.

use super::Answer;
use harness_shared::nearest;
use polars::prelude::*;
use sqlparser::ast::Ident;
use std::collections::BTreeMap;

/// The type of a value.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Type {
    /// The type of the literal `null`.
    Null,
    /// True or false.
    Flag,
    /// An integer of 64 bits.
    Integer,
    /// A real number of 32 bits, which some tables contain. It is converted to 64 bits before anything is computed.
    Single,
    /// A real number of 64 bits.
    Real,
    /// A text in UTF-8.
    Text,
    /// Bytes, such as an image.
    Bytes,
}

impl Type {
    /// The type of a table's column.
    pub fn of(data_type: &DataType) -> Self {
        match data_type {
            DataType::String => Type::Text,
            DataType::Float32 => Type::Single,
            DataType::Boolean => Type::Flag,
            DataType::Binary => Type::Bytes,
            other if other.is_integer() => Type::Integer,
            _ => Type::Real,
        }
    }

    /// The Polars type that stores values of this type.
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

    /// The type's name in messages, with an article where it needs one.
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

    /// Whether values of this type are numbers or null.
    pub fn is_number(self) -> bool {
        matches!(self, Type::Integer | Type::Single | Type::Real | Type::Null)
    }

    /// The type to which values of both types can be converted, if there is one.
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
    /// The name or alias of its table in the query. `None` for a merged column of USING, and for results of a query.
    pub table: Option<String>,
    /// The column's name in the query.
    pub name: String,
    /// The column's name in the frame, which is unique in the whole plan.
    pub id: String,
    /// The type of its values.
    pub kind: Type,
    /// Whether USING merged it into another column. Then it can only be named as `table.name`.
    pub merged: bool,
}

/// The rows and columns of a table, a join or a query.
#[derive(Clone)]
pub struct Relation {
    /// The plan that computes the rows.
    pub frame: LazyFrame,
    /// The columns, in order.
    pub columns: Vec<Column>,
    /// The estimated maximum number of rows, if a join is part of the relation.
    pub rows: Option<u64>,
    /// Number of times that the relation reads a table.
    pub reads: usize,
}

impl Relation {
    /// The table names of its columns, with repetitions.
    pub fn tables(&self) -> Vec<&str> {
        self.columns.iter().filter_map(|column| column.table.as_deref()).collect()
    }
}

/// Whether two names are equal in SQL, which ignores case.
pub fn same(a: &str, b: &str) -> bool {
    a.eq_ignore_ascii_case(b)
}

/// The reason why a name could not be resolved to a column, with a message.
pub enum Unresolved {
    /// No column has this name.
    Unknown(String),
    /// Several columns have this name.
    Ambiguous(String),
}

/// Finds the column that `path` names: `column` or `table.column`.
pub fn resolve<'a>(columns: &'a [Column], path: &[Ident]) -> Result<&'a Column, Unresolved> {
    let (table, name) = match path {
        [name] => (None, name.value.as_str()),
        [table, name] => (Some(table.value.as_str()), name.value.as_str()),
        _ => {
            let path: Vec<&str> = path.iter().map(|part| part.value.as_str()).collect();
            return Err(Unresolved::Unknown(format!(
                "'{}' is not a column; write table.column",
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
            let mut places: Vec<String> = several
                .iter()
                .filter_map(|column| Some(format!("{}.{}", column.table.as_ref()?, column.name)))
                .collect();
            places.dedup();
            let places = if places.len() < several.len() {
                "give them different names with AS".to_owned()
            } else {
                format!("write {}", places.join(" or "))
            };
            Err(Unresolved::Ambiguous(format!("'{name}' is ambiguous; {places}")))
        }
        (_, Some(table)) => Err(Unresolved::Ambiguous(format!(
            "'{table}' has several columns '{name}'; give them different names with AS"
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

/// The end of a message about an unknown name: the name that was probably meant, and all names.
pub fn choice(wanted: &str, names: &[&str]) -> String {
    let meant = nearest(wanted, names).map(|name| format!("; did you mean '{name}'?"));
    match (names, meant) {
        ([], _) => String::new(),
        (names, Some(meant)) if names.len() > 40 => format!("{meant} DESCRIBE lists a table's columns"),
        (names, None) if names.len() > 40 => "; DESCRIBE lists a table's columns".to_owned(),
        (names, Some(meant)) => format!("{meant} There are {}", names.join(", ")),
        (names, None) => format!("; there are {}", names.join(", ")),
    }
}

/// The queries of WITH (common table expressions), by name in lower case.
pub type Ctes = BTreeMap<String, Relation>;

/// The maximum number of rows of a join. A join may have more if it has no more rows than the larger of its tables.
pub const MAX_JOIN_ROWS: u64 = 1_000_000;

/// Refuses a join of too many rows. `larger` is the number of rows of the larger table.
pub fn within_rows(rows: u64, larger: u64) -> Answer<()> {
    if rows <= MAX_JOIN_ROWS.max(larger) {
        return Ok(());
    }
    refuse!(
        "a join in it has {rows} rows, but at most {MAX_JOIN_ROWS} are allowed; join by more columns with \
         ON a.column = b.column, or select from each table first"
    )
}

/// Refuses the first of `parts` that is present. Each part has three fields: whether it is present, its name, and what
/// to do instead.
pub fn none_of(parts: &[(bool, &str, &str)]) -> Answer<()> {
    match parts.iter().find(|(is_there, _, _)| *is_there) {
        None => Ok(()),
        Some((_, name, instead)) => refuse!("{name} is not supported; {instead}"),
    }
}
