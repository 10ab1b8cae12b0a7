//! ORDER BY: the direction of a key, and sorted rows.

use super::Answer;
use super::scope::none_of;
use polars::prelude::*;
use sqlparser::ast;

/// Whether a key of ORDER BY is descending, and whether nulls come last, which is the default.
pub fn direction(key: &ast::OrderByExpr) -> Answer<(bool, bool)> {
    none_of(&[(key.with_fill.is_some(), "WITH FILL", "leave it out")])?;
    Ok(options_of(&key.options))
}

/// Whether the order is descending, and whether nulls come last.
pub fn options_of(options: &ast::OrderByOptions) -> (bool, bool) {
    (options.asc == Some(false), options.nulls_first != Some(true))
}

/// The keys that rows are sorted by, and their options.
#[derive(Default)]
pub struct Sorting {
    by: Vec<Expr>,
    descending: Vec<bool>,
    nulls_last: Vec<bool>,
}

impl Sorting {
    /// Adds a key, and whether it is descending, and whether nulls come last.
    pub fn add(&mut self, by: Expr, (descending, nulls_last): (bool, bool)) {
        self.by.push(by);
        self.descending.push(descending);
        self.nulls_last.push(nulls_last);
    }

    /// The sorted rows. Rows with equal keys keep their order.
    pub fn of(self, frame: LazyFrame) -> LazyFrame {
        if self.by.is_empty() {
            return frame;
        }
        let options = SortMultipleOptions::default()
            .with_order_descending_multi(self.descending)
            .with_nulls_last_multi(self.nulls_last)
            .with_maintain_order(true);
        frame.sort_by_exprs(self.by, options)
    }
}
