//! Conditions from the WHERE clauses of a query, so that rows which the query can't see need not be read.

use polars::prelude::*;
use sqlparser::ast::{
    BinaryOperator, Expr as Sql, JoinOperator, Query, Select, SetExpr, Statement, TableFactor, Value,
    ValueWithSpan, Visit, Visitor,
};
use std::collections::btree_map::Entry;
use std::collections::{BTreeMap, BTreeSet};
use std::ops::ControlFlow;

/// A condition on rows: the texts that each of some columns may have. An empty set of texts stands for null. All rows
/// satisfy a condition without columns.
pub type Condition = BTreeMap<String, BTreeSet<String>>;

/// The conditions that a query puts on the rows of each table that it reads, by the table's name in lower case.
pub fn of_tables(statement: &Statement) -> BTreeMap<String, BTreeSet<Condition>> {
    let mut readers = Readers::default();
    let _ = statement.visit(&mut readers);
    let of_table = |(table, conditions): (String, Vec<Condition>)| {
        // `add_select` misses some places of a table, such as nested joins. These may read any row.
        let conditions = match readers.found.get(&table) {
            Some(found) if *found == conditions.len() => conditions.into_iter().collect(),
            _ => BTreeSet::from([Condition::new()]),
        };
        (table, conditions)
    };
    readers.conditions.into_iter().map(of_table).collect()
}

/// Finds the parts of a query that read tables, and their conditions.
#[derive(Default)]
struct Readers {
    /// How many times the query names each table.
    found: BTreeMap<String, usize>,
    conditions: BTreeMap<String, Vec<Condition>>,
}

/// The name of a table in lower case, and its alias or name in its part of the query. `None` for other factors.
fn named(factor: &TableFactor) -> Option<(String, String)> {
    let TableFactor::Table { name, alias, args: None, .. } = factor else { return None };
    let table = name.to_string().trim_matches('"').to_ascii_lowercase();
    let name = alias.as_ref().map_or_else(|| table.clone(), |alias| alias.name.value.clone());
    Some((table, name))
}

impl Readers {
    fn add_select(&mut self, select: &Select) {
        for from in &select.from {
            let is_inner =
                |operator: &JoinOperator| matches!(operator, JoinOperator::Join(_) | JoinOperator::Inner(_));
            let can_filter =
                select.from.len() == 1 && from.joins.iter().all(|join| is_inner(&join.join_operator));
            let factors = std::iter::once(&from.relation).chain(from.joins.iter().map(|join| &join.relation));
            for (factor, (table, name)) in factors.filter_map(|factor| Some((factor, named(factor)?))) {
                let mut condition = Condition::new();
                let can_filter = can_filter && !has_own_columns(factor);
                if let Some(filter) = select.selection.as_ref().filter(|_| can_filter) {
                    add_terms(filter, &name, &mut condition);
                }
                self.conditions.entry(table).or_default().push(condition);
            }
        }
    }
}

/// Adds those terms of a conjunction that compare a column of the table called `name` with texts or null.
fn add_terms(filter: &Sql, name: &str, condition: &mut Condition) {
    let (column, texts) = match filter {
        Sql::Nested(inner) => return add_terms(inner, name, condition),
        Sql::BinaryOp { left, op: BinaryOperator::And, right } => {
            add_terms(left, name, condition);
            return add_terms(right, name, condition);
        }
        Sql::BinaryOp { left, op: BinaryOperator::Eq, right } => (left.as_ref(), vec![text(right)]),
        Sql::InList { expr, list, negated: false } if !list.is_empty() => {
            (expr.as_ref(), list.iter().map(text).collect())
        }
        Sql::IsNull(expr) => (expr.as_ref(), Vec::new()),
        _ => return,
    };
    let column = match column {
        Sql::Identifier(column) => &column.value,
        Sql::CompoundIdentifier(parts) => match parts.as_slice() {
            [table, column] if table.value == name => &column.value,
            _ => return,
        },
        _ => return,
    };
    let Some(texts) = texts.into_iter().collect::<Option<BTreeSet<String>>>() else { return };
    condition.entry(column.clone()).or_insert(texts);
}

/// Whether an alias gives the columns of a table other names: `FROM epochs AS e(a, b)`.
fn has_own_columns(factor: &TableFactor) -> bool {
    matches!(factor, TableFactor::Table { alias: Some(alias), .. } if !alias.columns.is_empty())
}

/// The text of a literal in single quotes; `None` for other expressions.
fn text(expr: &Sql) -> Option<String> {
    match expr {
        Sql::Value(ValueWithSpan { value: Value::SingleQuotedString(text), .. }) => Some(text.clone()),
        _ => None,
    }
}

impl Visitor for Readers {
    type Break = ();

    fn pre_visit_query(&mut self, query: &Query) -> ControlFlow<()> {
        let mut bodies = vec![query.body.as_ref()];
        while let Some(body) = bodies.pop() {
            match body {
                SetExpr::Select(select) => self.add_select(select),
                SetExpr::SetOperation { left, right, .. } => bodies.extend([left.as_ref(), right.as_ref()]),
                // The visitor visits queries in parentheses on their own.
                _ => {}
            }
        }
        ControlFlow::Continue(())
    }

    fn pre_visit_table_factor(&mut self, factor: &TableFactor) -> ControlFlow<()> {
        if let Some((table, _)) = named(factor) {
            *self.found.entry(table.clone()).or_default() += 1;
            self.conditions.entry(table).or_default();
        }
        ControlFlow::Continue(())
    }
}

/// Whether all rows that satisfy `narrow` also satisfy `wide`.
pub fn implies(narrow: &Condition, wide: &Condition) -> bool {
    wide.iter().all(|(column, wanted)| match narrow.get(column) {
        // An empty set stands for null, so it is a subset of no other set.
        Some(texts) => texts.is_empty() == wanted.is_empty() && texts.is_subset(wanted),
        None => false,
    })
}

/// The rows in which each term of some conditions holds. Conditions share most of their terms, so the result of each
/// term is kept.
#[derive(Default)]
pub struct Terms(BTreeMap<(String, BTreeSet<String>), BooleanChunked>);

impl Terms {
    /// A mask of the rows that satisfy at least one of the conditions. Returns `None` if there are no conditions, or
    /// one that all rows satisfy. All calls must pass the same rows.
    ///
    /// # Errors
    /// When a condition names a column that does not exist, or asks for texts in a column of another type.
    pub fn wanted(
        &mut self,
        rows: &DataFrame,
        conditions: &BTreeSet<Condition>,
    ) -> PolarsResult<Option<BooleanChunked>> {
        if conditions.is_empty() || conditions.iter().any(BTreeMap::is_empty) {
            return Ok(None);
        }
        let mut wanted = BooleanChunked::full("wanted".into(), false, rows.height());
        for condition in conditions {
            let mut all = BooleanChunked::full("wanted".into(), true, rows.height());
            for (column, texts) in condition {
                let holds = match self.0.entry((column.clone(), texts.clone())) {
                    Entry::Occupied(known) => known.into_mut(),
                    Entry::Vacant(entry) => entry.insert(holds(rows.column(column)?, texts)?),
                };
                all = all & holds.clone();
            }
            wanted = wanted | all;
        }
        Ok(Some(wanted))
    }
}

/// A mask of the rows in which a column has one of the texts or, if there are none, is null.
fn holds(column: &polars::prelude::Column, texts: &BTreeSet<String>) -> PolarsResult<BooleanChunked> {
    if texts.is_empty() {
        return Ok(column.is_null());
    }
    let column = column.str()?;
    let none = BooleanChunked::full("wanted".into(), false, column.len());
    Ok(texts.iter().fold(none, |any, text| any | column.equal(text.as_str())))
}
