//! Translates SQL queries to Polars plans.
//!
//! `sqlparser` parses a query, and Polars computes the answer. This module applies the rules of standard SQL for names,
//! types, groups, joins and windows. A query that might be answered differently from the standard is refused. The tests
//! in `tests/sql` compare answers with DuckDB.

mod expression;
mod functions;
mod join;
mod plan;
mod scope;
mod window;

use super::QueryError;
use harness_tables::schema::{Column, Table};
use plan::{Ctes, Planner};
use polars::prelude::*;
use scope::{Type, choice, same};
use sqlparser::ast::{Expr, ObjectName, Query, Statement, Visit, Visitor};
use sqlparser::dialect::GenericDialect;
use sqlparser::parser::{Parser, ParserError, ParserOptions};
use sqlparser::tokenizer::Tokenizer;
use std::collections::BTreeSet;
use std::ops::ControlFlow;

/// The maximum length of a query, in bytes.
const MAX_QUERY_BYTES: usize = 1 << 20;
/// The maximum number of tokens of a query.
const MAX_QUERY_TOKENS: usize = 20_000;
/// The maximum nesting of parentheses, functions and subqueries. The parser tries two to four ways to parse a level, so
/// its time can grow exponentially with the nesting.
const MAX_QUERY_NESTING: usize = 16;
/// The maximum length of a chain of operators or WHENs. Polars processes it recursively, on threads with small stacks.
const MAX_QUERY_DEPTH: usize = 200;
/// The maximum number of copies of a part of an expression. Each BETWEEN inside a BETWEEN doubles their number.
const MAX_QUERY_COPIES: usize = 256;
const NO_QUESTION: &str = "it is not a query; use SELECT, WITH, SHOW TABLES, DESCRIBE or EXPLAIN";
/// The maximum number of characters of the query that a message repeats.
const MAX_SHOWN: usize = 80;

type Answer<T> = Result<T, QueryError>;

fn refuse<T>(reason: String) -> Answer<T> {
    Err(QueryError::Refused(reason))
}

/// A part of the query for a message, shortened to [`MAX_SHOWN`] characters.
fn shown(part: &impl std::fmt::Display) -> String {
    let text = part.to_string();
    match text.char_indices().nth(MAX_SHOWN) {
        None => text,
        Some((end, _)) => format!("{}…", &text[..end]),
    }
}

/// Answers one statement. `source` returns the rows of a table, and is called once for each table that is read.
/// `columns` returns the columns of a table that DESCRIBE lists.
///
/// # Errors
/// When the statement is invalid, not supported or too large, when `source` or `columns` fails, or when Polars does.
pub fn answer(
    sql: &str,
    source: &dyn Fn(Table) -> Answer<LazyFrame>,
    columns: &dyn Fn(Table) -> Answer<Vec<Column>>,
) -> Answer<DataFrame> {
    let statement = parsed(sql)?;
    let planner = Planner::new(source);
    match &statement {
        Statement::Query(query) => Ok(planned(&planner, query)?.collect()?),
        Statement::Explain { statement, .. } => match statement.as_ref() {
            Statement::Query(query) => {
                let plan = planned(&planner, query)?.describe_optimized_plan()?;
                Ok(df!("plan" => plan.lines().collect::<Vec<_>>())?)
            }
            _ => refuse(NO_QUESTION.into()),
        },
        Statement::ShowTables { .. } => {
            let names = Table::ALL.map(Table::name);
            let rows = Table::ALL.map(Table::meaning);
            Ok(df!("table" => names, "meaning" => rows)?)
        }
        Statement::ExplainTable { table_name, .. } => described(table_name, columns),
        Statement::ShowColumns { show_options, .. } => {
            match show_options.show_in.as_ref().and_then(|show_in| show_in.parent_name.as_ref()) {
                Some(table) => described(table, columns),
                None => refuse("SHOW COLUMNS needs a table: SHOW COLUMNS FROM runs".into()),
            }
        }
        _ => refuse(NO_QUESTION.into()),
    }
}

/// The plan of a query. Its columns have the names that the query gives them.
fn planned(planner: &Planner, query: &Query) -> Answer<LazyFrame> {
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

/// The answer of DESCRIBE: name, type, unit and meaning of each column of a table.
fn described(name: &ObjectName, columns: &dyn Fn(Table) -> Answer<Vec<Column>>) -> Answer<DataFrame> {
    let name = name.to_string();
    let Some(table) = Table::ALL.into_iter().find(|table| same(table.name(), &name)) else {
        return refuse(format!("there is no table '{name}'{}", choice(&name, &Table::ALL.map(Table::name))));
    };
    let columns = columns(table)?;
    let names: Vec<&str> = columns.iter().map(|column| column.name.as_str()).collect();
    let types: Vec<String> =
        columns.iter().map(|column| format!("{:?}", column.kind).to_lowercase()).collect();
    let units: Vec<&str> = columns.iter().map(|column| &*column.unit).collect();
    let meanings: Vec<&str> = columns.iter().map(|column| column.meaning.as_str()).collect();
    Ok(df!("column" => names, "type" => types, "unit" => units, "meaning" => meanings)?)
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

/// Parses a query of one statement, and checks its length and nesting, because the parser and Polars are recursive.
fn parsed(sql: &str) -> Answer<Statement> {
    if sql.len() > MAX_QUERY_BYTES {
        return refuse(format!("it has {} bytes, but at most {MAX_QUERY_BYTES} are allowed", sql.len()));
    }
    if sql.contains('\0') {
        return refuse("it has a null character".into());
    }
    let syntax = |error: ParserError| match error {
        ParserError::RecursionLimitExceeded => QueryError::Refused(
            "its parentheses, functions or subqueries are nested too deeply; use WITH".into(),
        ),
        error => QueryError::Refused(error.to_string()),
    };
    let options = ParserOptions { trailing_commas: true, ..ParserOptions::default() };
    let tokens = Tokenizer::new(&GenericDialect, sql).tokenize().map_err(|error| syntax(error.into()))?;
    if tokens.len() > MAX_QUERY_TOKENS {
        return refuse(format!("it has {} tokens, but at most {MAX_QUERY_TOKENS} are allowed", tokens.len()));
    }
    let parser = Parser::new(&GenericDialect).with_options(options).with_recursion_limit(MAX_QUERY_NESTING);
    let mut parser = parser.try_with_sql(sql).map_err(syntax)?;
    let mut statements = parser.parse_statements().map_err(syntax)?;
    let found = statements.len();
    let Some(statement) = statements.pop().filter(|_| found == 1) else {
        return refuse(format!("it has {found} statements instead of one"));
    };
    match statement.visit(&mut Bounds::default()) {
        ControlFlow::Break(reason) => refuse(reason),
        ControlFlow::Continue(()) => Ok(statement),
    }
}

/// Visits a query, and stops at an expression that is nested too deeply or copied too often.
struct Bounds {
    depth: usize,
    /// Number of copies of the expression that is being visited.
    copies: usize,
}

impl Default for Bounds {
    fn default() -> Self {
        Self { depth: 0, copies: 1 }
    }
}

/// The number of times that the plan copies a part of an expression: `x between a and b` becomes `x >= a and x <= b`.
fn copies(expr: &Expr) -> usize {
    match expr {
        Expr::Between { .. } => 2,
        Expr::Case { operand: Some(_), conditions, .. } => conditions.len().max(1),
        Expr::InList { list, .. } => {
            2 + list.iter().filter(|item| !matches!(item, Expr::Value(_) | Expr::UnaryOp { .. })).count()
        }
        Expr::InSubquery { .. } => 2,
        Expr::Function(function) => match function.name.to_string().to_lowercase().as_str() {
            "nullif" | "sign" => 2,
            _ => 1,
        },
        _ => 1,
    }
}

/// The number of levels that an expression adds to the nesting of its parts.
fn depth(expr: &Expr) -> usize {
    match expr {
        Expr::Case { conditions, .. } => conditions.len().max(1),
        _ => 1,
    }
}

impl Visitor for Bounds {
    type Break = String;

    fn pre_visit_expr(&mut self, expr: &Expr) -> ControlFlow<String> {
        self.depth += depth(expr);
        self.copies = self.copies.saturating_mul(copies(expr));
        if self.depth > MAX_QUERY_DEPTH {
            return ControlFlow::Break(format!(
                "an expression in it, such as a + b + c + …, is nested more than {MAX_QUERY_DEPTH} levels deep; \
                 use a list or a sum"
            ));
        }
        if self.copies > MAX_QUERY_COPIES {
            return ControlFlow::Break("BETWEEN, CASE or IN are nested too deeply; use a subquery".into());
        }
        ControlFlow::Continue(())
    }

    fn post_visit_expr(&mut self, expr: &Expr) -> ControlFlow<String> {
        self.depth -= depth(expr);
        self.copies /= copies(expr);
        ControlFlow::Continue(())
    }
}
