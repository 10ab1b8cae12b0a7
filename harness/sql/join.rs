//! Plans FROM: tables, subqueries and joins.

use super::expression::Planning;
use super::plan::Planner;
use super::scope::{
    Column, Ctes, MAX_JOIN_ROWS, Relation, Type, choice, none_of, resolve, same, within_rows,
};
use super::syntax::{is_plain, split_and};
use super::value::{Value, one_row};
use super::{Answer, shown};
use polars::prelude::*;
use sqlparser::ast::{self, JoinConstraint, JoinOperator, TableFactor};
use std::collections::BTreeSet;

/// The kind of a join: the side whose rows it keeps when they have no partner.
#[derive(Clone, Copy, PartialEq)]
enum Side {
    Inner,
    Left,
    Right,
    Full,
}

impl Planner<'_> {
    /// Plans FROM. Also applies, and removes from `conditions`, the conditions of WHERE that use only one table or that
    /// join the tables of `FROM a, b`, so that fewer rows are joined.
    pub fn from<'s>(
        &self,
        from: &'s [ast::TableWithJoins],
        conditions: &mut Vec<&'s ast::Expr>,
        ctes: &Ctes,
    ) -> Answer<Relation> {
        let mut tables = Vec::with_capacity(from.len());
        for ast::TableWithJoins { relation, joins } in from {
            let mut joined = vec![(self.factor(relation, ctes)?, None)];
            for join in joins {
                joined.push((self.factor(&join.relation, ctes)?, Some(&join.join_operator)));
            }
            tables.push(joined);
        }
        self.filter_tables(&mut tables, conditions, ctes);
        let mut all: Option<Relation> = None;
        for joined in tables {
            let mut left: Option<Relation> = None;
            for (right, operator) in joined {
                left = Some(match (left, operator) {
                    (Some(left), Some(operator)) => self.joined(left, right, operator, ctes)?,
                    _ => right,
                });
            }
            all = match (all, left) {
                (Some(left), Some(right)) => Some(self.side_by_side(left, right, conditions, ctes)?),
                (_, left) => left,
            };
        }
        Ok(all.unwrap_or_else(|| Relation { frame: one_row(), columns: Vec::new(), rows: None, reads: 0 }))
    }

    /// Applies each condition that uses a single table to that table, and removes it from `conditions`. The condition
    /// stays if an outer join could add rows with nulls for the table.
    fn filter_tables(
        &self,
        tables: &mut [Vec<(Relation, Option<&JoinOperator>)>],
        conditions: &mut Vec<&ast::Expr>,
        ctes: &Ctes,
    ) {
        let side = |operator: &Option<&JoinOperator>| operator.and_then(Side::of).map(|(side, _)| side);
        let all: Vec<Column> =
            tables.iter().flatten().flat_map(|(relation, _)| relation.columns.clone()).collect();
        conditions.retain(|condition| {
            if !is_plain(condition) {
                return true;
            }
            let Ok(bound) = self.binder(&all, "WHERE", ctes).condition(condition) else {
                return true;
            };
            for joined in tables.iter_mut() {
                let keeps_left = |(_, operator): &(Relation, Option<&JoinOperator>)| {
                    !matches!(side(operator), Some(Side::Right | Side::Full))
                };
                if !joined.iter().all(keeps_left) {
                    continue;
                }
                for (relation, operator) in joined.iter_mut() {
                    if side(operator) != Some(Side::Left) && is_of(&bound, &relation.columns) {
                        relation.frame = relation.frame.clone().filter(bound);
                        return false;
                    }
                }
            }
            true
        });
    }

    /// Plans `FROM a, b` as a join by those conditions that compare columns of both for equality.
    fn side_by_side<'s>(
        &self,
        left: Relation,
        right: Relation,
        conditions: &mut Vec<&'s ast::Expr>,
        ctes: &Ctes,
    ) -> Answer<Relation> {
        let both = [left.columns.clone(), right.columns.clone()].concat();
        let is_key = |condition: &&'s ast::Expr| {
            is_plain(condition) && matches!(self.equality(condition, &left.columns, &both, ctes), Ok(Some(_)))
        };
        let (keys, others) = conditions.iter().copied().partition(is_key);
        *conditions = others;
        self.join(left, right, Side::Inner, &keys, ctes)
    }

    /// The two sides of the condition `a = b`, that of the left table first. Returns `None` for any other condition.
    fn equality(
        &self,
        condition: &ast::Expr,
        left: &[Column],
        both: &[Column],
        ctes: &Ctes,
    ) -> Answer<Option<(Expr, Expr)>> {
        let ast::Expr::BinaryOp { left: a, op: ast::BinaryOperator::Eq, right: b } = condition else {
            return Ok(None);
        };
        let binder = self.binder(both, "ON", ctes);
        let (a, b) = (binder.bind(a)?, binder.bind(b)?);
        let Some(kind) = a.kind.common(b.kind) else {
            return Ok(None);
        };
        let right: Vec<Column> =
            both.iter().filter(|column| left.iter().all(|other| other.id != column.id)).cloned().collect();
        Ok(if is_of(&a.expr, left) && is_of(&b.expr, &right) {
            Some((a.to(kind), b.to(kind)))
        } else if is_of(&a.expr, &right) && is_of(&b.expr, left) {
            Some((b.to(kind), a.to(kind)))
        } else {
            None
        })
    }

    /// Plans a table, a query of WITH, a subquery, or a join in parentheses.
    fn factor(&self, factor: &TableFactor, ctes: &Ctes) -> Answer<Relation> {
        match factor {
            TableFactor::Table {
                name,
                alias,
                args,
                with_hints,
                version,
                with_ordinality,
                partitions,
                json_path,
                sample,
                index_hints,
            } => {
                let written = name.to_string();
                if args.is_some() {
                    return refuse!(
                        "'{written}' is not a table, and other files can't be read; {}",
                        self.there_are(ctes)
                    );
                }
                none_of(&[
                    (
                        !with_hints.is_empty()
                            || version.is_some()
                            || *with_ordinality
                            || !partitions.is_empty()
                            || json_path.is_some()
                            || !index_hints.is_empty(),
                        "what follows the table's name",
                        "leave it out",
                    ),
                    (sample.is_some(), "TABLESAMPLE", "use LIMIT"),
                ])?;
                let [ast::ObjectNamePart::Identifier(name)] = name.0.as_slice() else {
                    return refuse!("there is no table '{written}'; {}", self.there_are(ctes));
                };
                let relation = self.table(&name.value, ctes)?;
                self.named(relation, alias.as_ref(), &name.value)
            }
            TableFactor::Derived { lateral, subquery, alias, sample } => {
                none_of(&[
                    (*lateral, "LATERAL", "use a join"),
                    (sample.is_some(), "TABLESAMPLE", "use LIMIT"),
                ])?;
                let relation = self.query(subquery, ctes)?;
                match alias {
                    Some(alias) => self.named(relation, Some(alias), &alias.name.value),
                    None => self.named(relation, None, ""),
                }
            }
            TableFactor::NestedJoin { table_with_joins, alias: None } => {
                self.from(std::slice::from_ref(table_with_joins), &mut Vec::new(), ctes)
            }
            other => refuse!("'{}' is not supported in FROM; {}", shown(other), self.there_are(ctes)),
        }
    }

    fn table(&self, name: &str, ctes: &Ctes) -> Answer<Relation> {
        if let Some(relation) = ctes.get(&name.to_lowercase()) {
            return Ok(relation.clone());
        }
        let names = self.table_names(ctes);
        let Some(table) = names.iter().find(|known| same(known, name)) else {
            return refuse!("there is no table '{name}'{}", choice(name, &names));
        };
        let known = self.read.borrow().get(*table).cloned();
        let frame = match known {
            Some(frame) => frame,
            None => {
                let frame = self.tables.rows(table, self.asked)?;
                self.read.borrow_mut().insert((*table).to_owned(), frame.clone());
                frame
            }
        };
        let schema = frame.clone().collect_schema()?;
        let columns = schema.iter().map(|(name, data_type)| Column {
            table: None,
            name: name.to_string(),
            id: name.to_string(),
            kind: Type::of(data_type),
            merged: false,
        });
        Ok(Relation { frame, columns: columns.collect(), rows: None, reads: 1 })
    }

    /// The names that FROM can use: those of the queries of WITH, and those of the tables.
    fn table_names<'n>(&self, ctes: &'n Ctes) -> Vec<&'n str> {
        let tables = self.tables.list().into_iter().map(|(name, _)| name);
        ctes.keys().map(String::as_str).chain(tables).collect()
    }

    fn there_are(&self, ctes: &Ctes) -> String {
        format!("the tables are {}", self.table_names(ctes).join(", "))
    }

    /// Renames a relation to its alias or `name`. Its columns get new ids, because a query may read a table twice.
    pub fn named(&self, relation: Relation, alias: Option<&ast::TableAlias>, name: &str) -> Answer<Relation> {
        let given: Vec<String> = match alias {
            None => Vec::new(),
            Some(ast::TableAlias { explicit: _, name: _, columns, at: _ }) => {
                columns.iter().map(|column| column.name.value.clone()).collect()
            }
        };
        let name = alias.map_or(name, |alias| &alias.name.value);
        if given.len() > relation.columns.len() {
            return refuse!(
                "'{name}' names {} columns, but there are {}",
                given.len(),
                relation.columns.len()
            );
        }
        let mut given = given.into_iter();
        let (mut columns, mut kept) = (Vec::new(), Vec::new());
        for column in relation.columns.into_iter().filter(|column| !column.merged) {
            let id = self.fresh();
            kept.push(col(&*column.id).alias(&id));
            let table = (!name.is_empty()).then(|| name.to_owned());
            columns.push(Column { table, name: given.next().unwrap_or(column.name), id, ..column });
        }
        Ok(Relation { frame: relation.frame.select(kept), columns, ..relation })
    }

    fn joined(
        &self,
        left: Relation,
        right: Relation,
        operator: &JoinOperator,
        ctes: &Ctes,
    ) -> Answer<Relation> {
        let Some((side, constraint)) = Side::of(operator) else {
            return refuse!("use JOIN, LEFT JOIN, RIGHT JOIN, FULL JOIN or CROSS JOIN");
        };
        if let Some(name) =
            left.tables().iter().find(|name| right.tables().iter().any(|other| same(other, name)))
        {
            return refuse!(
                "'{name}' is in FROM twice; give it two names: FROM {name} AS a JOIN {name} AS b"
            );
        }
        match constraint {
            JoinConstraint::On(on) => {
                let mut conditions = Vec::new();
                split_and(Some(on), &mut conditions);
                self.join(left, right, side, &conditions, ctes)
            }
            JoinConstraint::None if matches!(operator, JoinOperator::CrossJoin(_)) => {
                self.join(left, right, side, &[], ctes)
            }
            JoinConstraint::Using(names) => self.join_using(left, right, side, names),
            JoinConstraint::Natural => {
                refuse!("NATURAL JOIN is not supported; name the columns: JOIN … USING (…)")
            }
            JoinConstraint::None => {
                refuse!("JOIN needs a condition: ON a.column = b.column; or write CROSS JOIN")
            }
        }
    }

    /// Plans `JOIN … USING (…)`. The columns of each name become one column, with the value of the left side or, where
    /// that is null, of the right side.
    fn join_using(
        &self,
        left: Relation,
        right: Relation,
        side: Side,
        names: &[ast::ObjectName],
    ) -> Answer<Relation> {
        let (mut keys, mut merged) = (Vec::new(), Vec::new());
        for name in names {
            let [ast::ObjectNamePart::Identifier(name)] = name.0.as_slice() else {
                return refuse!("USING takes names of columns, not '{name}'");
            };
            let path = std::slice::from_ref(name);
            let find = |relation: &Relation| match resolve(&relation.columns, path) {
                Ok(column) => Ok(column.clone()),
                Err(_) => {
                    refuse!("USING takes columns that each side has exactly once, not '{}'", name.value)
                }
            };
            let (a, b) = (find(&left)?, find(&right)?);
            let Some(kind) = a.kind.common(b.kind) else {
                return refuse!(
                    "'{}' is {} on one side and {} on the other",
                    a.name,
                    a.kind.name(),
                    b.kind.name()
                );
            };
            let (left, right) =
                (Value::column(&a.id, a.kind).to(kind), Value::column(&b.id, b.kind).to(kind));
            keys.push((left.clone(), right.clone()));
            let id = self.fresh();
            merged.push((
                coalesce(&[left, right]).alias(&id),
                Column { table: None, name: a.name.clone(), id, kind, merged: false },
                [a.id, b.id],
            ));
        }
        let both = self.join_on(left, right, side, keys, &[])?;
        let hidden: BTreeSet<&String> = merged.iter().flat_map(|(_, _, ids)| ids).collect();
        let columns = merged.iter().map(|(_, column, _)| column.clone()).chain(both.columns.into_iter().map(
            |column| {
                let merged = column.merged || hidden.contains(&column.id);
                Column { merged, ..column }
            },
        ));
        let added: Vec<Expr> = merged.iter().map(|(expr, _, _)| expr.clone()).collect();
        Ok(Relation { columns: columns.collect(), frame: both.frame.with_columns(added), ..both })
    }

    fn join(
        &self,
        mut left: Relation,
        mut right: Relation,
        side: Side,
        conditions: &[&ast::Expr],
        ctes: &Ctes,
    ) -> Answer<Relation> {
        let both = [left.columns.clone(), right.columns.clone()].concat();
        let (mut keys, mut others) = (Vec::new(), Vec::new());
        for condition in conditions {
            if let Some(key) = self.equality(condition, &left.columns, &both, ctes)? {
                keys.push(key);
                continue;
            }
            let other = self.binder(&both, "ON", ctes).condition(condition)?;
            // A condition on one table can be applied before the join, unless the join keeps that table's rows without
            // a partner.
            if is_of(&other, &left.columns) && matches!(side, Side::Inner | Side::Right) {
                left.frame = left.frame.filter(other);
            } else if is_of(&other, &right.columns) && matches!(side, Side::Inner | Side::Left) {
                right.frame = right.frame.filter(other);
            } else {
                others.push(other);
            }
        }
        self.join_on(left, right, side, keys, &others)
    }

    /// Joins the pairs of rows in which all `keys` are equal and all conditions `others` are true.
    fn join_on(
        &self,
        left: Relation,
        right: Relation,
        side: Side,
        keys: Vec<(Expr, Expr)>,
        others: &[Expr],
    ) -> Answer<Relation> {
        let columns = [left.columns.clone(), right.columns.clone()].concat();
        let ids: Vec<(String, String)> = keys.iter().map(|_| (self.fresh(), self.fresh())).collect();
        let (left_keys, right_keys): (Vec<Expr>, Vec<Expr>) = keys
            .into_iter()
            .zip(&ids)
            .map(|((left, right), (left_id, right_id))| (left.alias(left_id), right.alias(right_id)))
            .unzip();
        let (row, other_row) = (self.fresh(), self.fresh());
        // Two parts of an outer join use the numbers. The order of rows may differ between two evaluations of a table.
        let numbered = |frame: LazyFrame, keys: Vec<Expr>, row: &str| {
            frame.with_columns(keys).with_row_index(row, None).cache()
        };
        // An outer join needs row numbers to find the rows that have no partner.
        let (a, b) = if side == Side::Inner {
            (left.frame.with_columns(left_keys), right.frame.with_columns(right_keys))
        } else {
            (numbered(left.frame, left_keys, &row), numbered(right.frame, right_keys, &other_row))
        };
        let (left_ids, right_ids): (Vec<Expr>, Vec<Expr>) =
            ids.iter().map(|(left, right)| (col(&**left), col(&**right))).unzip();
        let rows = joined_rows(&a, &b, &left_ids, &right_ids)?;
        let matched = if ids.is_empty() {
            a.clone().cross_join(b.clone(), None)
        } else {
            let join = a.clone().join_builder().with(b.clone()).left_on(left_ids).right_on(right_ids);
            let join = join.how(JoinType::Inner).coalesce(JoinCoalesce::KeepColumns);
            join.maintain_order(MaintainOrderJoin::LeftRight).finish()
        };
        let matched = others.iter().fold(matched, |frame, condition| frame.filter(condition.clone()));
        let kept: Vec<Expr> = columns.iter().map(|column| col(&*column.id)).collect();
        let reads = left.reads + right.reads;
        let mut parts = vec![matched.clone().select(&kept)];
        // The rows of one side that have no partner, with nulls for the other side.
        let alone = |frame: &LazyFrame, row: &str, own: &[Column]| {
            let nulls = columns.iter().map(|column| {
                let is_own = own.iter().any(|other| other.id == column.id);
                if is_own { col(&*column.id) } else { Value::null(column.kind).expr.alias(&*column.id) }
            });
            let partners = matched.clone().select([col(row)]);
            let alone = frame.clone().join_builder().with(partners).on([col(row)]).how(JoinType::Anti);
            alone.maintain_order(MaintainOrderJoin::Left).finish().select(nulls.collect::<Vec<_>>())
        };
        if matches!(side, Side::Left | Side::Full) {
            parts.push(alone(&a, &row, &left.columns));
        }
        if matches!(side, Side::Right | Side::Full) {
            parts.push(alone(&b, &other_row, &right.columns));
        }
        let frame = if parts.len() == 1 { parts.remove(0) } else { concat(parts, UnionArgs::default())? };
        Ok(Relation { frame, columns, rows: Some(rows), reads })
    }
}

impl Side {
    /// The kind and the constraint of a join, or `None` if it is not supported.
    fn of(operator: &JoinOperator) -> Option<(Self, &JoinConstraint)> {
        match operator {
            JoinOperator::Join(constraint)
            | JoinOperator::Inner(constraint)
            | JoinOperator::CrossJoin(constraint) => Some((Side::Inner, constraint)),
            JoinOperator::Left(constraint) | JoinOperator::LeftOuter(constraint) => {
                Some((Side::Left, constraint))
            }
            JoinOperator::Right(constraint) | JoinOperator::RightOuter(constraint) => {
                Some((Side::Right, constraint))
            }
            JoinOperator::FullOuter(constraint) => Some((Side::Full, constraint)),
            _ => None,
        }
    }
}

/// Whether an expression uses columns, all of which are among `columns`.
fn is_of(expr: &Expr, columns: &[Column]) -> bool {
    let names = expr.into_iter().filter_map(|part| match part {
        Expr::Column(name) => Some(name),
        _ => None,
    });
    let mut names = names.peekable();
    names.peek().is_some() && names.all(|name| columns.iter().any(|column| column.id == **name))
}

/// The number of rows of a join by these keys, before other conditions, plus the number of rows of the larger table,
/// which an outer join may keep.
///
/// # Errors
/// When the join has too many rows.
fn joined_rows(left: &LazyFrame, right: &LazyFrame, left_ids: &[Expr], right_ids: &[Expr]) -> Answer<u64> {
    let count = |frame: &LazyFrame| -> Answer<u64> {
        let rows = frame.clone().select([len().cast(DataType::UInt64).alias("rows")]).collect()?;
        Ok(rows.column("rows")?.u64()?.get(0).unwrap_or(0))
    };
    let (left_rows, right_rows) = (count(left)?, count(right)?);
    let product = left_rows.saturating_mul(right_rows);
    let larger = left_rows.max(right_rows);
    let rows = if left_ids.is_empty() || product <= MAX_JOIN_ROWS {
        product
    } else {
        let counted = |frame: &LazyFrame, ids: &[Expr], name: &str| {
            frame.clone().group_by(ids).agg([len().cast(DataType::UInt64).alias(name)])
        };
        let (left, right) = (counted(left, left_ids, "left"), counted(right, right_ids, "right"));
        let both = left.join_builder().with(right).left_on(left_ids).right_on(right_ids).finish();
        let rows = both.select([(col("left") * col("right")).sum().alias("rows")]).collect()?;
        rows.column("rows")?.u64()?.get(0).unwrap_or(0)
    };
    within_rows(rows, larger)?;
    Ok(rows.saturating_add(larger))
}
