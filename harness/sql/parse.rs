//! Parses queries, and bounds their length and nesting.

use super::{Answer, SqlError};
use sqlparser::ast::{Expr, Statement, Visit, Visitor};
use sqlparser::dialect::GenericDialect;
use sqlparser::parser::{Parser, ParserError, ParserOptions};
use sqlparser::tokenizer::{Token, Tokenizer};
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

/// Parses a query of one statement, and checks its length and nesting, because the parser and Polars are recursive.
/// Also returns all words of the query outside of texts.
pub fn parsed(sql: &str) -> Answer<(Statement, BTreeSet<String>)> {
    if sql.len() > MAX_QUERY_BYTES {
        return refuse!("it has {} bytes, but at most {MAX_QUERY_BYTES} are allowed", sql.len());
    }
    if sql.contains('\0') {
        return refuse!("it has a null character");
    }
    let syntax = |error: ParserError| match error {
        ParserError::RecursionLimitExceeded => SqlError::Refused(
            "its parentheses, functions or subqueries are nested too deeply; use WITH".into(),
        ),
        error => SqlError::Refused(error.to_string()),
    };
    let options = ParserOptions { trailing_commas: true, ..ParserOptions::default() };
    let tokens = Tokenizer::new(&GenericDialect, sql).tokenize_with_location();
    let tokens = tokens.map_err(|error| syntax(error.into()))?;
    if tokens.len() > MAX_QUERY_TOKENS {
        return refuse!("it has {} tokens, but at most {MAX_QUERY_TOKENS} are allowed", tokens.len());
    }
    let words = tokens.iter().filter_map(|token| match &token.token {
        Token::Word(word) => Some(word.value.clone()),
        _ => None,
    });
    let words = words.collect();
    let parser = Parser::new(&GenericDialect).with_options(options).with_recursion_limit(MAX_QUERY_NESTING);
    let mut statements = parser.with_tokens_with_locations(tokens).parse_statements().map_err(syntax)?;
    let found = statements.len();
    let Some(statement) = statements.pop().filter(|_| found == 1) else {
        return refuse!("it has {found} statements instead of one");
    };
    match statement.visit(&mut Bounds { depth: 0, copies: 1 }) {
        ControlFlow::Break(reason) => Err(SqlError::Refused(reason)),
        ControlFlow::Continue(()) => Ok((statement, words)),
    }
}

/// Visits a query, and stops at an expression that is nested too deeply or copied too often.
struct Bounds {
    depth: usize,
    /// Number of copies of the expression that is being visited.
    copies: usize,
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
