//! Translates SQL queries to Polars plans.
//!
//! `sqlparser` parses a query once, into a [`Query`]. Polars computes the answer. This crate applies the rules of
//! standard SQL for names, types, groups, joins and windows. It reads the tables through the trait [`Tables`]. A query
//! that might be answered differently from the standard is refused. The tests in `tests/sql` compare answers with
//! DuckDB.

/// Refuses a query with a message, which is written as for `format!`.
macro_rules! refuse {
    ($($message:tt)*) => {
        Err($crate::SqlError::Refused(format!($($message)*)))
    };
}

mod condition;
mod expression;
mod functions;
mod join;
mod order;
mod parse;
mod plan;
mod scope;
mod syntax;
mod value;
mod window;

pub use condition::{Condition, Terms, implies};

/// Returns a text as SQL has it, in single quotes.
pub fn text_in_sql(text: &str) -> String {
    format!("'{}'", text.replace('\'', "''"))
}

use plan::Planner;
use polars::prelude::*;
use scope::{Ctes, Type, choice, same};
use sqlparser::ast::{self, ObjectName, Statement};
use std::collections::{BTreeMap, BTreeSet};

/// Address space for the stack on which a query is parsed and planned: `1+1+1…` nests as deep as it is long, and
/// the parser and Polars walk what nests by recursion. Only what is used takes memory.
const STACK_BYTES: usize = 1 << 30;
const NO_QUESTION: &str = "it is not a query; use SELECT, WITH, SHOW TABLES, DESCRIBE or EXPLAIN";
/// The maximum number of characters of the query that a message repeats.
const MAX_SHOWN: usize = 80;

/// Why a query can't be answered.
#[derive(Debug, thiserror::Error)]
pub enum SqlError {
    /// The query is wrong or not supported. The message says what to write instead.
    #[error("{0}")]
    Refused(String),
    /// Polars failed to compute the answer, or the rows of a table can't be read.
    #[error(transparent)]
    Polars(#[from] PolarsError),
}

/// The tables that queries can read.
pub trait Tables: Sync {
    /// The names of the tables, in lower case, each with a description of its rows.
    fn list(&self) -> Vec<(&'static str, &'static str)>;

    /// The answer of DESCRIBE: a row for each column of a table.
    fn columns(&self, table: &str) -> PolarsResult<DataFrame>;

    /// The rows of a table. Rows that satisfy none of the query's [`conditions`](Query::conditions) may be left out.
    fn rows(&self, table: &str, query: &Query) -> PolarsResult<LazyFrame>;
}

/// A query of one statement, parsed.
#[derive(Debug)]
pub struct Query {
    statement: Statement,
    names: BTreeSet<String>,
    /// The conditions on the rows of each table that the query reads, by the table's name in lower case.
    conditions: BTreeMap<String, BTreeSet<Condition>>,
}

impl Query {
    /// Parses a query.
    ///
    /// # Errors
    /// When the query is no single statement, or is too large.
    pub fn parse(sql: &str) -> Result<Self, SqlError> {
        on_large_stack(|| {
            let (statement, names) = parse::parsed(sql)?;
            Ok(Self { conditions: condition::of_tables(&statement), statement, names })
        })
    }

    /// All words of the query outside of texts, with the names of its columns among them.
    pub fn names(&self) -> &BTreeSet<String> {
        &self.names
    }

    /// The conditions that the query puts on the rows of a table, one for each part of the query that reads the table.
    /// The query can only see rows that satisfy at least one of them. They may name columns that the table does not
    /// have. `None` if the query does not read the table.
    pub fn conditions(&self, table: &str) -> Option<&BTreeSet<Condition>> {
        self.conditions.get(table)
    }

    /// Answers the query. The rows of each table that it reads are asked for once.
    pub fn answer(&self, tables: &dyn Tables) -> Result<DataFrame, SqlError> {
        on_large_stack(|| self.answered(tables))
    }

    fn answered(&self, tables: &dyn Tables) -> Answer<DataFrame> {
        let planner = Planner::new(self, tables);
        match &self.statement {
            Statement::Query(query) => Ok(planned(&planner, query)?.collect()?),
            Statement::Explain { statement, .. } => match statement.as_ref() {
                Statement::Query(query) => {
                    let plan = planned(&planner, query)?.describe_optimized_plan()?;
                    Ok(df!("plan" => plan.lines().collect::<Vec<_>>())?)
                }
                _ => refuse!("{NO_QUESTION}"),
            },
            Statement::ShowTables { .. } => {
                let (names, rows): (Vec<_>, Vec<_>) = tables.list().into_iter().unzip();
                Ok(df!("table" => names, "meaning" => rows)?)
            }
            Statement::ExplainTable { table_name, .. } => described(table_name, tables),
            Statement::ShowColumns { show_options, .. } => {
                match show_options.show_in.as_ref().and_then(|show_in| show_in.parent_name.as_ref()) {
                    Some(table) => described(table, tables),
                    None => refuse!("SHOW COLUMNS needs a table: SHOW COLUMNS FROM runs"),
                }
            }
            _ => refuse!("{NO_QUESTION}"),
        }
    }
}

type Answer<T> = Result<T, SqlError>;

/// A part of the query for a message, shortened to [`MAX_SHOWN`] characters.
fn shown(part: &impl std::fmt::Display) -> String {
    let text = part.to_string();
    match text.char_indices().nth(MAX_SHOWN) {
        None => text,
        Some((end, _)) => format!("{}…", &text[..end]),
    }
}

/// Calls a function on a thread with a large stack. Polars may panic at what it does not support.
fn on_large_stack<T: Send>(function: impl FnOnce() -> Answer<T> + Send) -> Answer<T> {
    std::thread::scope(|scope| {
        let thread = std::thread::Builder::new().stack_size(STACK_BYTES).spawn_scoped(scope, function);
        let thread = thread.map_err(|error| SqlError::Refused(error.to_string()))?;
        thread.join().unwrap_or_else(|panic| {
            let said = panic.downcast_ref::<String>().map(String::as_str);
            let said = said.or(panic.downcast_ref::<&str>().copied()).unwrap_or("it panicked");
            refuse!("Polars does not support it: {said}")
        })
    })
}

/// The plan of a query. Its columns have the names that the query gives them.
fn planned(planner: &Planner, query: &ast::Query) -> Answer<LazyFrame> {
    let relation = planner.query(query, &Ctes::new())?;
    let names = distinct_names(relation.columns.iter().map(|column| column.name.clone()));
    let columns = relation.columns.iter().zip(names).map(|(column, name)| {
        // A column of nothing but nulls has no type. As text it can be written to all formats.
        let value = col(&*column.id);
        let value = if column.kind == Type::Null { value.cast(DataType::String) } else { value };
        value.alias(name)
    });
    Ok(relation.frame.select(columns.collect::<Vec<_>>()))
}

/// The answer of DESCRIBE for the table of this name.
fn described(name: &ObjectName, tables: &dyn Tables) -> Answer<DataFrame> {
    let name = name.to_string();
    let known: Vec<&str> = tables.list().into_iter().map(|(known, _)| known).collect();
    match known.iter().find(|known| same(known, &name)) {
        Some(table) => Ok(tables.columns(table)?),
        None => refuse!("there is no table '{name}'{}", choice(&name, &known)),
    }
}

/// Makes names distinct by appending numbers: the second `run` becomes `run_1`.
fn distinct_names(names: impl Iterator<Item = String>) -> Vec<String> {
    let names: Vec<String> = names.collect();
    let mut taken: BTreeSet<String> = BTreeSet::new();
    let given: BTreeSet<&String> = names.iter().collect();
    let mut distinct = Vec::with_capacity(names.len());
    for name in &names {
        let mut candidates = std::iter::once(name.clone())
            .chain((1..).map(|number| format!("{name}_{number}")).filter(|name| !given.contains(name)));
        let free = candidates.find(|name| !taken.contains(name)).expect("there is no end of numbers");
        taken.insert(free.clone());
        distinct.push(free);
    }
    distinct
}
