//! SQL over the tables of a results folder.

use super::folders::Recorded;
use super::record::{RunRecord, runs_table};
use super::{Registry, RegistryError, Status};
use crate::files::{WriteError, write_whole};
use crate::schema::{Column, Table};
use crate::tables::{TableError, data_type, scan};
use polars::prelude::*;
use polars::sql::SQLContext;
use rayon::prelude::*;
use serde::de::DeserializeOwned;
use sqlparser::ast::{Expr, Statement, TableFactor, Visit, Visitor};
use sqlparser::dialect::GenericDialect;
use sqlparser::parser::{Parser, ParserError, ParserOptions};
use sqlparser::tokenizer::Tokenizer;
use std::fs::File;
use std::ops::ControlFlow;
use std::path::{Path, PathBuf};

/// The longest query, bytes.
const MAX_QUERY_BYTES: usize = 1 << 20;
/// The most words and signs of a query.
const MAX_QUERY_TOKENS: usize = 20_000;
/// The deepest nesting of brackets, functions and subqueries: of some, the parser tries each level in two to four
/// ways, all of them when the innermost is wrong.
const MAX_QUERY_NESTING: usize = 16;
/// The longest chain of operators: Polars takes time and memory that grow with the square of the depth, 8 GB at 10,000.
const MAX_QUERY_DEPTH: usize = 1000;
/// The most copies of a part of an expression; each `between` within a `between` doubles their number.
const MAX_QUERY_COPIES: usize = 256;
/// Address space for the stack on which a query is parsed and planned: `1+1+1…` nests as deep as it is long, and
/// the parser and Polars walk what nests by recursion. Only what is used takes memory.
const QUERY_STACK_BYTES: usize = 1 << 30;

/// Why a query gave no answer.
#[derive(Debug, thiserror::Error)]
pub enum QueryError {
    #[error(transparent)]
    Registry(#[from] RegistryError),
    #[error("the query can't be answered: {0}")]
    Sql(PolarsError),
    #[error("the query can't be answered: {0}")]
    Refused(String),
    #[error("the answer's rows are not what they should be: {0}")]
    Rows(serde_json::Error),
    #[error("can't write to '{}': its name must end in .parquet, .csv or .json", .0.display())]
    Format(PathBuf),
    #[error(transparent)]
    Write(#[from] WriteError),
}

/// Answers a query in Polars' SQL over the tables of [`Table::ALL`].
///
/// A query asks and does nothing else: Polars also knows statements that change tables and functions that read any
/// file, and both are refused. What can't be used as it lies there is left out, see [`Registry::left_out`].
///
/// # Errors
/// When the SQL is not understood, is more than a question, names what isn't there, or when a table's file is
/// damaged.
pub fn query(registry: &Registry, sql: &str) -> Result<DataFrame, QueryError> {
    answer(registry, sql, &registry.recorded())
}

/// As [`query`], but of the runs only those that count: done, and of several of the same cell and seed in an
/// experiment (after a setting or the method changed) the latest.
pub fn query_latest(registry: &Registry, sql: &str) -> Result<DataFrame, QueryError> {
    answer(registry, sql, &registry.latest())
}

fn answer(registry: &Registry, sql: &str, runs: &[Recorded]) -> Result<DataFrame, QueryError> {
    std::thread::scope(|scope| {
        let thread = std::thread::Builder::new().stack_size(QUERY_STACK_BYTES);
        let thread = thread.spawn_scoped(scope, || execute(registry, sql, runs));
        let thread = thread.map_err(|error| QueryError::Refused(error.to_string()))?;
        // Polars panics at some queries that it does not support, as `interval '1 t'`.
        thread.join().unwrap_or_else(|panic| {
            let said = panic.downcast_ref::<String>().map(String::as_str);
            let said = said.or(panic.downcast_ref::<&str>().copied()).unwrap_or("it panicked");
            Err(QueryError::Refused(format!("Polars does not support it: {said}")))
        })
    })
}

fn execute(registry: &Registry, sql: &str, runs: &[Recorded]) -> Result<DataFrame, QueryError> {
    only_asks(sql)?;
    let mut context = SQLContext::new();
    for table in Table::ALL {
        // Only what the query may be about is looked up: the folders of thousands of runs take a while.
        if sql.to_lowercase().contains(table.name()) {
            context.register(table.name(), table_of(registry, table, runs)?);
        }
    }
    context.execute(sql).and_then(LazyFrame::collect).map_err(QueryError::Sql)
}

/// Refuses what is no single question about the tables, or too long for a parser that calls itself.
fn only_asks(sql: &str) -> Result<(), QueryError> {
    let refuse = |reason: String| Err(QueryError::Refused(reason));
    if sql.len() > MAX_QUERY_BYTES {
        return refuse(format!("it has {} bytes, and {MAX_QUERY_BYTES} are allowed", sql.len()));
    }
    let syntax = |error: ParserError| match error {
        ParserError::RecursionLimitExceeded => {
            QueryError::Refused("its brackets, functions or subqueries nest too deep; use WITH".into())
        }
        error => QueryError::Refused(error.to_string()),
    };
    // As Polars parses it.
    let options = ParserOptions { trailing_commas: true, ..ParserOptions::default() };
    let tokens = Tokenizer::new(&GenericDialect, sql).tokenize().map_err(|error| syntax(error.into()))?;
    if tokens.len() > MAX_QUERY_TOKENS {
        return refuse(format!(
            "it has {} words and signs, and {MAX_QUERY_TOKENS} are allowed",
            tokens.len()
        ));
    }
    let parser = Parser::new(&GenericDialect).with_options(options).with_recursion_limit(MAX_QUERY_NESTING);
    let mut parser = parser.try_with_sql(sql).map_err(syntax)?;
    let statements = parser.parse_statements().map_err(syntax)?;
    let [statement] = statements.as_slice() else {
        return refuse(format!("it has {} statements instead of one", statements.len()));
    };
    let question = match statement {
        Statement::Explain { statement, .. } => statement,
        other => other,
    };
    if !matches!(question, Statement::Query(_) | Statement::ShowTables { .. }) {
        return refuse("it is no question; use SELECT, WITH, EXPLAIN or SHOW TABLES".into());
    }
    match statement.visit(&mut Bounds::default()) {
        ControlFlow::Break(reason) => refuse(reason),
        ControlFlow::Continue(()) => Ok(()),
    }
}

/// Stops at whatever a query reads from that has arguments, as `read_csv('file')`, and where it nests too deep.
struct Bounds {
    depth: usize,
    /// How often Polars copies the expression that is being visited.
    copies: usize,
}

impl Default for Bounds {
    fn default() -> Self {
        Self { depth: 0, copies: 1 }
    }
}

/// How often Polars copies each part of an expression: `x between a and b` becomes `x >= a and x <= b`.
fn copies(expr: &Expr) -> usize {
    match expr {
        Expr::Between { .. } => 2,
        Expr::Case { operand: Some(_), conditions, .. } => conditions.len().max(1),
        _ => 1,
    }
}

impl Visitor for Bounds {
    type Break = String;

    fn pre_visit_table_factor(&mut self, factor: &TableFactor) -> ControlFlow<String> {
        match factor {
            TableFactor::Table { name, args: Some(_), .. } => ControlFlow::Break(format!(
                "'{name}' is no table, and other files can't be read; the tables are {}",
                Table::ALL.map(Table::name).join(", ")
            )),
            _ => ControlFlow::Continue(()),
        }
    }

    fn pre_visit_expr(&mut self, expr: &Expr) -> ControlFlow<String> {
        self.depth += 1;
        self.copies = self.copies.saturating_mul(copies(expr));
        if self.depth > MAX_QUERY_DEPTH {
            return ControlFlow::Break(format!(
                "an expression in it nests more than {MAX_QUERY_DEPTH} deep, as a + b + c + … does; use a list or a sum"
            ));
        }
        if self.copies > MAX_QUERY_COPIES {
            return ControlFlow::Break("BETWEEN or CASE in it nest too deep; use a subquery".into());
        }
        ControlFlow::Continue(())
    }

    fn post_visit_expr(&mut self, expr: &Expr) -> ControlFlow<String> {
        self.depth -= 1;
        self.copies /= copies(expr);
        ControlFlow::Continue(())
    }
}

/// One of the tables, over everything in the results folder.
pub fn table(registry: &Registry, table: Table) -> Result<LazyFrame, QueryError> {
    table_of(registry, table, &registry.recorded())
}

/// One of the tables, over `runs`, or over all datasets.
fn table_of(registry: &Registry, table: Table, runs: &[Recorded]) -> Result<LazyFrame, QueryError> {
    let columns = table.columns();
    let found = match table {
        Table::Runs => {
            if runs.is_empty() {
                None
            } else {
                let records: Vec<RunRecord> = runs.iter().map(|(_, record)| record.clone()).collect();
                Some(runs_table(&records).map_err(TableError::from).map_err(RegistryError::from)?.lazy())
            }
        }
        Table::Episodes => scan(&registry.episode_files(runs)?, &columns).map_err(QueryError::Sql)?,
        Table::Epochs | Table::Metrics | Table::Predictions | Table::Forces | Table::Frames => {
            let name = format!("{}.parquet", table.name());
            // A run's tables count once its record says that it is done, and as its record lists them.
            let done: Vec<&Recorded> = runs.iter().filter(|(_, run)| run.status == Status::Done).collect();
            let paths = done.into_par_iter().map(|(folder, record)| record.check_file(folder, &name));
            scan(&paths.collect::<Result<Vec<_>, _>>()?, &columns).map_err(QueryError::Sql)?
        }
    };
    match found {
        Some(found) => Ok(found),
        None => empty(&columns).map_err(QueryError::Sql),
    }
}

/// A table without rows, so that a query of an empty results folder has an empty answer.
fn empty(columns: &[Column]) -> PolarsResult<LazyFrame> {
    let columns = columns.iter().map(|column| {
        polars::prelude::Column::new_empty(column.name.as_str().into(), &data_type(column.kind))
    });
    Ok(DataFrame::new(0, columns.collect())?.lazy())
}

/// An answer's rows as values of `T`, whose fields are its columns.
///
/// # Errors
/// When a column lacks or has another type.
pub fn rows<T: DeserializeOwned>(answer: &mut DataFrame) -> Result<Vec<T>, QueryError> {
    let mut json = Vec::new();
    JsonWriter::new(&mut json).with_json_format(JsonFormat::Json).finish(answer).map_err(QueryError::Sql)?;
    serde_json::from_slice(&json).map_err(QueryError::Rows)
}

/// Writes an answer as Parquet, CSV or JSON, by the ending of the file's name.
pub fn save(answer: &mut DataFrame, path: &Path) -> Result<(), QueryError> {
    let ending = path.extension().and_then(|ending| ending.to_str()).unwrap_or_default().to_lowercase();
    let write: fn(&mut DataFrame, File) -> PolarsResult<()> = match ending.as_str() {
        "parquet" => |answer, file| ParquetWriter::new(file).finish(answer).map(|_| ()),
        "csv" => |answer, file| CsvWriter::new(file).finish(answer),
        "json" => |answer, file| JsonWriter::new(file).with_json_format(JsonFormat::Json).finish(answer),
        _ => return Err(QueryError::Format(path.to_owned())),
    };
    write_whole(path, |file| write(answer, File::create(file)?).map_err(std::io::Error::other))?;
    Ok(())
}
