//! What a question in SQL means, as a plan of Polars.
//!
//! `sqlparser` parses, Polars computes; between them stand the standard's rules of names, groups, joins and windows.
//! What is not known to be answered as the standard says is refused: `tests/sql` compares with DuckDB.

mod expression;
mod functions;
mod join;
mod plan;
mod scope;
mod window;

use super::query::QueryError;
use harness_tables::schema::Table;
use plan::{Ctes, Planner};
use polars::prelude::*;
use scope::{Type, choice, same};
use sqlparser::ast::{Expr, ObjectName, Query, Statement, Visit, Visitor};
use sqlparser::dialect::GenericDialect;
use sqlparser::parser::{Parser, ParserError, ParserOptions};
use sqlparser::tokenizer::Tokenizer;
use std::collections::BTreeSet;
use std::ops::ControlFlow;

/// The longest query, bytes.
const MAX_QUERY_BYTES: usize = 1 << 20;
/// The most words and signs of a query.
const MAX_QUERY_TOKENS: usize = 20_000;
/// The deepest nesting of brackets, functions and subqueries: of some, the parser tries each level in two to four
/// ways, all of them when the innermost is wrong.
const MAX_QUERY_NESTING: usize = 16;
/// The longest chain of operators, and of WHENs: Polars walks them by recursion, on threads with small stacks.
const MAX_QUERY_DEPTH: usize = 200;
/// The most copies of a part of an expression; each `between` within a `between` doubles their number.
const MAX_QUERY_COPIES: usize = 256;
const NO_QUESTION: &str = "it is no question; use SELECT, WITH, SHOW TABLES, DESCRIBE or EXPLAIN";
/// Most letters of the query that a message repeats.
const MAX_SHOWN: usize = 80;

type Answer<T> = Result<T, QueryError>;

fn refuse<T>(reason: String) -> Answer<T> {
    Err(QueryError::Refused(reason))
}

/// A part of the query as a message repeats it.
fn shown(part: &impl std::fmt::Display) -> String {
    let text = part.to_string();
    match text.char_indices().nth(MAX_SHOWN) {
        None => text,
        Some((end, _)) => format!("{}…", &text[..end]),
    }
}

/// Answers one statement over the tables that `source` gives.
pub fn answer(sql: &str, source: &dyn Fn(Table) -> Answer<LazyFrame>) -> Answer<DataFrame> {
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
        Statement::ExplainTable { table_name, .. } => described(table_name),
        Statement::ShowColumns { show_options, .. } => {
            match show_options.show_in.as_ref().and_then(|show_in| show_in.parent_name.as_ref()) {
                Some(table) => described(table),
                None => refuse("SHOW COLUMNS needs a table: SHOW COLUMNS FROM runs".into()),
            }
        }
        _ => refuse(NO_QUESTION.into()),
    }
}

/// The plan of a query, whose columns have the names that the query gives.
fn planned(planner: &Planner, query: &Query) -> Answer<LazyFrame> {
    let relation = planner.query(query, &Ctes::new())?;
    let names = distinct_names(relation.columns.iter().map(|column| column.name.clone()));
    let columns = relation.columns.iter().zip(names).map(|(column, name)| {
        // A column of nulls alone has no type of its own; as text it can be written everywhere.
        let value = col(&*column.id);
        let value = if column.kind == Type::Null { value.cast(DataType::String) } else { value };
        value.alias(name)
    });
    Ok(relation.frame.select(columns.collect::<Vec<_>>()))
}

/// The columns of a table.
fn described(name: &ObjectName) -> Answer<DataFrame> {
    let name = name.to_string();
    let Some(table) = Table::ALL.into_iter().find(|table| same(table.name(), &name)) else {
        return refuse(format!("there is no table '{name}'{}", choice(&name, &Table::ALL.map(Table::name))));
    };
    let columns = table.columns();
    let names: Vec<&str> = columns.iter().map(|column| column.name.as_str()).collect();
    let types: Vec<String> =
        columns.iter().map(|column| format!("{:?}", column.kind).to_lowercase()).collect();
    let units: Vec<&str> = columns.iter().map(|column| &*column.unit).collect();
    let meanings: Vec<&str> = columns.iter().map(|column| column.meaning.as_str()).collect();
    Ok(df!("column" => names, "type" => types, "unit" => units, "meaning" => meanings)?)
}

/// Names that are told apart: the second `run` becomes `run_1`.
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

/// The only statement of a query that is not too long for a parser that calls itself.
fn parsed(sql: &str) -> Answer<Statement> {
    if sql.len() > MAX_QUERY_BYTES {
        return refuse(format!("it has {} bytes, and {MAX_QUERY_BYTES} are allowed", sql.len()));
    }
    let syntax = |error: ParserError| match error {
        ParserError::RecursionLimitExceeded => {
            QueryError::Refused("its brackets, functions or subqueries nest too deep; use WITH".into())
        }
        error => QueryError::Refused(error.to_string()),
    };
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

/// Stops where a query nests too deep.
struct Bounds {
    depth: usize,
    /// How often the expression that is being visited is copied.
    copies: usize,
}

impl Default for Bounds {
    fn default() -> Self {
        Self { depth: 0, copies: 1 }
    }
}

/// How often each part of an expression is copied: `x between a and b` becomes `x >= a and x <= b`.
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

/// How deep an expression nests its parts.
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
                "an expression in it nests more than {MAX_QUERY_DEPTH} deep, as a + b + c + … does; use a list or a sum"
            ));
        }
        if self.copies > MAX_QUERY_COPIES {
            return ControlFlow::Break("BETWEEN, CASE or IN in it nest too deep; use a subquery".into());
        }
        ControlFlow::Continue(())
    }

    fn post_visit_expr(&mut self, expr: &Expr) -> ControlFlow<String> {
        self.depth -= depth(expr);
        self.copies /= copies(expr);
        ControlFlow::Continue(())
    }
}
