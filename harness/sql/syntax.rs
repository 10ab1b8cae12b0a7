//! What the syntax of an expression tells about it.

use super::functions::{self, Aggregate};
use sqlparser::ast::{self, BinaryOperator, UnaryOperator, Visit, Visitor};
use std::ops::ControlFlow;

/// The expression without its outer parentheses.
pub fn inner(expr: &ast::Expr) -> &ast::Expr {
    match expr {
        ast::Expr::Nested(expr) => inner(expr),
        expr => expr,
    }
}

/// Whether all operators of an expression, outside of parentheses, bind more tightly than a comparison.
pub fn is_operand(expr: &ast::Expr) -> bool {
    use BinaryOperator as B;
    match expr {
        ast::Expr::BinaryOp { op, .. } => {
            matches!(op, B::Plus | B::Minus | B::Multiply | B::Divide | B::Modulo | B::StringConcat)
        }
        ast::Expr::UnaryOp { op, .. } => *op != UnaryOperator::Not,
        other => matches!(
            other,
            ast::Expr::Identifier(_)
                | ast::Expr::CompoundIdentifier(_)
                | ast::Expr::Value(_)
                | ast::Expr::Nested(_)
                | ast::Expr::Function(_)
                | ast::Expr::Cast { .. }
                | ast::Expr::Case { .. }
                | ast::Expr::Subquery(_)
        ),
    }
}

/// Whether an expression uses values of only one row: it has no aggregates, window functions or subqueries.
pub fn is_plain(expr: &ast::Expr) -> bool {
    struct Plain;
    impl Visitor for Plain {
        type Break = ();
        fn pre_visit_query(&mut self, _: &ast::Query) -> ControlFlow<()> {
            ControlFlow::Break(())
        }
        fn pre_visit_expr(&mut self, expr: &ast::Expr) -> ControlFlow<()> {
            if is_aggregate(expr) { ControlFlow::Break(()) } else { ControlFlow::Continue(()) }
        }
    }
    expr.visit(&mut Plain).is_continue()
}

/// Whether an operation in an expression fails for some values.
pub fn can_fail(expr: &ast::Expr) -> bool {
    use BinaryOperator as B;
    let fails = |expr: &ast::Expr| match expr {
        ast::Expr::BinaryOp { op, .. } => matches!(op, B::Plus | B::Minus | B::Multiply | B::Modulo),
        ast::Expr::UnaryOp { op, expr } => {
            *op == UnaryOperator::Minus && !matches!(**expr, ast::Expr::Value(_))
        }
        ast::Expr::Cast { .. } => true,
        ast::Expr::Function(function) => {
            functions::FALLIBLE.contains(&&*function.name.to_string().to_lowercase())
        }
        _ => false,
    };
    let stop =
        |expr: &ast::Expr| if fails(expr) { ControlFlow::Break(()) } else { ControlFlow::Continue(()) };
    ast::visit_expressions(expr, stop).is_break()
}

/// Whether an expression is a call of an aggregate or window function.
fn is_aggregate(expr: &ast::Expr) -> bool {
    matches!(expr, ast::Expr::Function(function)
        if function.over.is_some() || Aggregate::is_name(&function.name.to_string().to_lowercase()))
}

/// Whether an expression contains an aggregate outside of subqueries. A call with OVER does not count, but an aggregate
/// inside its OVER does.
pub fn has_aggregate(expr: &ast::Expr) -> bool {
    #[derive(Default)]
    struct Found {
        queries: usize,
    }
    impl Visitor for Found {
        type Break = ();
        fn pre_visit_query(&mut self, _: &ast::Query) -> ControlFlow<()> {
            self.queries += 1;
            ControlFlow::Continue(())
        }
        fn post_visit_query(&mut self, _: &ast::Query) -> ControlFlow<()> {
            self.queries -= 1;
            ControlFlow::Continue(())
        }
        fn pre_visit_expr(&mut self, expr: &ast::Expr) -> ControlFlow<()> {
            match expr {
                ast::Expr::Function(function)
                    if self.queries == 0
                        && function.over.is_none()
                        && Aggregate::is_name(&function.name.to_string().to_lowercase()) =>
                {
                    ControlFlow::Break(())
                }
                _ => ControlFlow::Continue(()),
            }
        }
    }
    expr.visit(&mut Found::default()).is_break()
}

/// Splits a condition at its ANDs, and appends the parts to `conditions`.
pub fn split_and<'s>(condition: Option<&'s ast::Expr>, conditions: &mut Vec<&'s ast::Expr>) {
    match condition {
        None => {}
        Some(ast::Expr::Nested(condition)) => split_and(Some(condition), conditions),
        Some(ast::Expr::BinaryOp { left, op: ast::BinaryOperator::And, right }) => {
            split_and(Some(left), conditions);
            split_and(Some(right), conditions);
        }
        Some(condition) => conditions.push(condition),
    }
}
