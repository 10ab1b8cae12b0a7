//! Translates queries from the parser's tree to Polars plans. In a plan, every column has a unique id.

use super::expression::{Binder, Groups, Key, Needed, Planning};
use super::order::{Sorting, direction, options_of};
use super::scope::{Column, Ctes, Relation, Type, none_of, resolve, same, within_rows};
use super::syntax::{can_fail, has_aggregate, split_and};
use super::value::Value;
use super::window::Window;
use super::{Answer, Query, Tables, shown};
use polars::prelude::*;
use sqlparser::ast::{self, SetExpr, SetOperator, SetQuantifier};
use std::cell::{Cell, RefCell};
use std::collections::BTreeMap;

/// The maximum number of times that a query may read tables. Each UNION of a subquery with itself doubles the number.
const MAX_READS: usize = 200;

/// The maximum number of parts of all copies of the conditions of CASE. Beyond it, an operation that fails in a row
/// that CASE excludes is an error: Polars takes seconds for more.
const MAX_CONDITION_PARTS: usize = 100_000;

/// Plans one statement.
pub struct Planner<'a> {
    /// The query that contains everything that is planned.
    pub asked: &'a Query,
    /// The tables that it can read.
    pub tables: &'a dyn Tables,
    /// The tables that have been read so far, by name.
    pub read: RefCell<BTreeMap<String, LazyFrame>>,
    /// Number of ids given so far.
    names: Cell<usize>,
    /// Number of parts of the conditions of CASE that were copied so far.
    condition_parts: Cell<usize>,
    /// The columns of the queries that contain the subquery which is being planned.
    around: RefCell<Vec<Vec<Column>>>,
}

/// An item of SELECT: an expression, or a column that `*` stands for.
enum Item<'a> {
    Written(&'a ast::Expr),
    Column(Column),
}

impl<'a> Planner<'a> {
    /// A planner of the query `asked` over these tables.
    pub fn new(asked: &'a Query, tables: &'a dyn Tables) -> Self {
        Self {
            asked,
            tables,
            read: RefCell::default(),
            names: Cell::new(0),
            condition_parts: Cell::new(0),
            around: RefCell::default(),
        }
    }

    /// Plans a query with WITH, ORDER BY and LIMIT. `ctes` are the queries of the outer WITH.
    pub fn query(&self, query: &ast::Query, ctes: &Ctes) -> Answer<Relation> {
        let ast::Query {
            with,
            body,
            order_by,
            limit_clause,
            fetch,
            locks,
            for_clause,
            settings,
            format_clause,
            pipe_operators,
        } = query;
        none_of(&[
            (fetch.is_some(), "FETCH", "use LIMIT"),
            (!locks.is_empty() || for_clause.is_some(), "FOR", "leave it out"),
            (settings.is_some() || format_clause.is_some(), "SETTINGS and FORMAT", "leave it out"),
            (!pipe_operators.is_empty(), "|>", "use WITH"),
        ])?;
        let mut ctes = ctes.clone();
        if let Some(with) = with {
            none_of(&[(with.recursive, "WITH RECURSIVE", "use WITH")])?;
            for cte in &with.cte_tables {
                let relation = self.query(&cte.query, &ctes)?;
                let relation = self.named(relation, Some(&cte.alias), &cte.alias.name.value)?;
                ctes.insert(cte.alias.name.value.to_lowercase(), relation);
            }
        }
        let relation = match body.as_ref() {
            SetExpr::Select(select) => self.select(select, order_by.as_ref(), &ctes)?,
            body => self.ordered(self.body(body, &ctes)?, order_by.as_ref(), &ctes)?,
        };
        limited(relation, limit_clause.as_ref())
    }

    fn body(&self, body: &SetExpr, ctes: &Ctes) -> Answer<Relation> {
        match body {
            SetExpr::Select(select) => self.select(select, None, ctes),
            SetExpr::Query(query) => self.query(query, ctes),
            SetExpr::SetOperation { op, set_quantifier, left, right } => {
                self.combined(*op, *set_quantifier, self.body(left, ctes)?, self.body(right, ctes)?)
            }
            SetExpr::Values(_) => {
                refuse!("VALUES is not supported; write SELECT 1 AS a UNION ALL SELECT 2")
            }
            SetExpr::Table(_) => refuse!("TABLE is not supported; write SELECT * FROM"),
            _ => refuse!("it is not a query; use SELECT"),
        }
    }

    /// Plans UNION, INTERSECT or EXCEPT of two queries.
    fn combined(
        &self,
        op: SetOperator,
        quantifier: SetQuantifier,
        left: Relation,
        right: Relation,
    ) -> Answer<Relation> {
        let all = match (op, quantifier) {
            (_, SetQuantifier::None | SetQuantifier::Distinct) => false,
            (SetOperator::Union, SetQuantifier::All) => true,
            _ => return refuse!("'{op} {quantifier}' is not supported; use {op}"),
        };
        if left.columns.len() != right.columns.len() {
            let (left, right) = (left.columns.len(), right.columns.len());
            return refuse!(
                "{op} needs queries with the same number of columns; they have {left} and {right}"
            );
        }
        let (mut lefts, mut rights, mut columns) = (Vec::new(), Vec::new(), Vec::new());
        for (number, (left, right)) in left.columns.iter().zip(&right.columns).enumerate() {
            let Some(kind) = left.kind.common(right.kind) else {
                return refuse!(
                    "{op} of {} with {} in column {}",
                    left.kind.name(),
                    right.kind.name(),
                    number + 1
                );
            };
            let id = self.fresh();
            for (column, sides) in [(left, &mut lefts), (right, &mut rights)] {
                sides.push(Value::column(&column.id, column.kind).to(kind).alias(&id));
            }
            columns.push(Column { table: None, name: left.name.clone(), id, kind, merged: false });
        }
        let rows = match (left.rows, right.rows) {
            (None, None) => None,
            (left, right) => Some(left.unwrap_or(0).saturating_add(right.unwrap_or(0))),
        };
        within_rows(rows.unwrap_or(0), 0)?;
        let reads = left.reads + right.reads;
        if reads > MAX_READS {
            return refuse!("it reads tables {reads} times, but at most {MAX_READS} are allowed");
        }
        let (left, right) = (left.frame.select(lefts), right.frame.select(rights));
        let unique = |frame: LazyFrame| frame.unique_stable(None, UniqueKeepStrategy::First);
        let frame = match op {
            SetOperator::Union => {
                let both = concat([left, right], UnionArgs::default())?;
                if all { both } else { unique(both) }
            }
            SetOperator::Intersect | SetOperator::Except => {
                let on: Vec<Expr> = columns.iter().map(|column| col(&*column.id)).collect();
                let how = if op == SetOperator::Except { JoinType::Anti } else { JoinType::Semi };
                unique(left).join_builder().with(right).on(on).how(how).join_nulls(true).finish()
            }
            SetOperator::Minus => return refuse!("MINUS is not supported; use EXCEPT"),
        };
        Ok(Relation { frame, columns, rows, reads })
    }

    /// Plans ORDER BY of a query that is not a single SELECT. It can only use columns of the answer.
    fn ordered(&self, relation: Relation, order_by: Option<&ast::OrderBy>, ctes: &Ctes) -> Answer<Relation> {
        let Some(order_by) = order_by else {
            return Ok(relation);
        };
        let items: Vec<Item> = relation.columns.iter().cloned().map(Item::Column).collect();
        let names: Vec<String> = relation.columns.iter().map(|column| column.name.clone()).collect();
        let values: Vec<Value> =
            relation.columns.iter().map(|column| Value::column(&column.id, column.kind)).collect();
        let binder = self.binder(&relation.columns, "ORDER BY", ctes);
        let mut sorting = Sorting::default();
        for (key, options) in order_keys(order_by, values.len())? {
            let value = match placed(key, &items, &names)? {
                OrderKey::Place(place) => values[place].clone(),
                OrderKey::Written(expr) => binder.bind(&expr)?,
            };
            sorting.add(value.expr, options);
        }
        Ok(Relation { frame: sorting.of(relation.frame.clone()), ..relation })
    }

    /// A binder for a clause that can use these columns, without groups, window functions and aliases.
    pub fn binder<'b>(&'b self, columns: &'b [Column], clause: &'b str, ctes: &'b Ctes) -> Binder<'b> {
        Binder {
            planner: self,
            ctes,
            columns,
            clause,
            groups: None,
            windows: None,
            named_windows: &[],
            aliases: &[],
            needed: Needed::Always,
        }
    }

    fn select(&self, select: &ast::Select, order_by: Option<&ast::OrderBy>, ctes: &Ctes) -> Answer<Relation> {
        check_select(select)?;
        let mut conditions: Vec<&ast::Expr> = Vec::new();
        split_and(select.selection.as_ref(), &mut conditions);
        // A condition that can fail is only computed in the rows that satisfy the others.
        conditions.sort_by_key(|condition| can_fail(condition));
        let input = self.from(&select.from, &mut conditions, ctes)?;
        let aliases: Vec<(String, &ast::Expr)> = select
            .projection
            .iter()
            .filter_map(|item| match item {
                ast::SelectItem::ExprWithAlias { expr, alias } => Some((alias.value.clone(), expr)),
                _ => None,
            })
            .collect();
        let at = |clause| Binder {
            aliases: &aliases,
            named_windows: &select.named_window,
            ..self.binder(&input.columns, clause, ctes)
        };

        let mut frame = input.frame.clone();
        for condition in conditions {
            frame = frame.filter(at("WHERE").condition(condition)?);
        }

        let (items, names) = self.items(select, &input.columns)?;
        let order_keys = match order_by {
            Some(order_by) => order_keys(order_by, items.len())?,
            None => Vec::new(),
        };
        let keys = self.group_keys(select, &items, &names, &at("GROUP BY"))?;
        let written = items.iter().filter_map(|item| match item {
            Item::Written(expr) => Some(*expr),
            Item::Column(_) => None,
        });
        let ordered = order_keys.iter().filter_map(|(key, _)| match key {
            OrderKey::Written(expr) => Some(expr.as_ref()),
            OrderKey::Place(_) => None,
        });
        let after = ordered.chain(&select.having).chain(&select.qualify);
        let is_grouped =
            !keys.is_empty() || select.having.is_some() || written.chain(after).any(has_aggregate);
        let groups = RefCell::new(Groups { keys, arguments: Vec::new(), aggregates: Vec::new() });
        let windows = RefCell::new(Vec::<Window>::new());
        let grouped = |clause| Binder { groups: is_grouped.then_some(&groups), ..at(clause) };
        let windowed = |clause| Binder { windows: Some(&windows), ..grouped(clause) };

        let having = select.having.as_ref().map(|expr| grouped("HAVING").condition(expr)).transpose()?;
        let mut values = Vec::with_capacity(items.len());
        for item in &items {
            values.push(match item {
                Item::Written(expr) => Binder { aliases: &[], ..windowed("SELECT") }.bind(expr)?,
                Item::Column(_) if is_grouped => grouped("SELECT").bind(&item.expr())?,
                Item::Column(column) => Value::column(&column.id, column.kind),
            });
        }
        let qualify = select.qualify.as_ref().map(|expr| windowed("QUALIFY").condition(expr)).transpose()?;

        let is_distinct = matches!(select.distinct, Some(ast::Distinct::Distinct));
        let outputs: Vec<String> = items.iter().map(|_| self.fresh()).collect();
        let mut projected: Vec<Expr> =
            values.iter().zip(&outputs).map(|(value, id)| value.expr.clone().alias(id)).collect();
        let mut sorting = Sorting::default();
        for (key, options) in order_keys {
            let place = match placed(key, &items, &names)? {
                OrderKey::Place(place) => Some(place),
                OrderKey::Written(expr) => {
                    let value = windowed("ORDER BY").bind(&expr)?;
                    let place = values.iter().position(|other| other.expr == value.expr);
                    if place.is_none() && is_distinct {
                        return refuse!(
                            "with DISTINCT, ORDER BY can only use columns of SELECT; add '{}' to SELECT",
                            shown(&expr)
                        );
                    }
                    if place.is_none() {
                        let id = self.fresh();
                        projected.push(value.expr.alias(&id));
                        sorting.add(col(&*id), options);
                    }
                    place
                }
            };
            if let Some(place) = place {
                sorting.add(col(&*outputs[place]), options);
            }
        }

        let mut first_of = Vec::new();
        if let Some(ast::Distinct::On(keys)) = &select.distinct {
            for key in keys {
                let value = match placed(OrderKey::Written(Box::new(key.clone())), &items, &names)? {
                    OrderKey::Place(place) => values[place].clone(),
                    OrderKey::Written(expr) => windowed("DISTINCT ON").bind(&expr)?,
                };
                let id = self.fresh();
                projected.push(value.expr.alias(&id));
                first_of.push(col(&*id));
            }
        }

        if is_grouped {
            frame = aggregated(frame, groups.into_inner());
        }
        if let Some(having) = having {
            frame = frame.filter(having);
        }
        frame = windows.into_inner().iter().fold(frame, |frame, window: &Window| window.apply(frame));
        if let Some(qualify) = qualify {
            frame = frame.filter(qualify);
        }
        frame = frame.with_columns(projected);
        let kept: Vec<Expr> = outputs.iter().map(|id| col(&**id)).collect();
        if is_distinct {
            frame = frame.select(&kept).unique_stable(None, UniqueKeepStrategy::First);
        }
        frame = sorting.of(frame);
        if !first_of.is_empty() {
            frame = frame.unique_stable_generic(Some(first_of), UniqueKeepStrategy::First);
        }
        frame = frame.select(kept);
        let columns = names.into_iter().zip(outputs).zip(values).map(|((name, id), value)| Column {
            table: None,
            name,
            id,
            kind: value.kind,
            merged: false,
        });
        Ok(Relation { frame, columns: columns.collect(), rows: input.rows, reads: input.reads })
    }

    /// The items of SELECT and their names: the alias, the column's name, or the expression as it is written.
    fn items<'s>(&self, select: &'s ast::Select, columns: &[Column]) -> Answer<(Vec<Item<'s>>, Vec<String>)> {
        let (mut items, mut names) = (Vec::new(), Vec::new());
        let no_options = |options: &ast::WildcardAdditionalOptions| {
            if *options == ast::WildcardAdditionalOptions::default() {
                return Ok(());
            }
            refuse!("* with EXCLUDE, REPLACE or RENAME is not supported; name the columns")
        };
        for item in &select.projection {
            match item {
                ast::SelectItem::UnnamedExpr(expr) => {
                    names.push(match expr {
                        ast::Expr::Identifier(name) => name.value.clone(),
                        ast::Expr::CompoundIdentifier(path) => {
                            path.last().map_or(String::new(), |name| name.value.clone())
                        }
                        other => other.to_string(),
                    });
                    items.push(Item::Written(expr));
                }
                ast::SelectItem::ExprWithAlias { expr, alias } => {
                    names.push(alias.value.clone());
                    items.push(Item::Written(expr));
                }
                ast::SelectItem::Wildcard(options) => {
                    no_options(options)?;
                    if columns.is_empty() {
                        return refuse!("* needs a FROM");
                    }
                    for column in columns.iter().filter(|column| !column.merged) {
                        names.push(column.name.clone());
                        items.push(Item::Column(column.clone()));
                    }
                }
                ast::SelectItem::QualifiedWildcard(
                    ast::SelectItemQualifiedWildcardKind::ObjectName(table),
                    options,
                ) => {
                    no_options(options)?;
                    let table = table.to_string();
                    let is_of =
                        |column: &&Column| column.table.as_deref().is_some_and(|found| same(found, &table));
                    let found: Vec<&Column> = columns.iter().filter(is_of).collect();
                    if found.is_empty() {
                        return refuse!("there is no table '{table}' in its FROM");
                    }
                    for column in found {
                        names.push(column.name.clone());
                        items.push(Item::Column(column.clone()));
                    }
                }
                other => return refuse!("'{other}' is not supported"),
            }
        }
        Ok((items, names))
    }

    fn group_keys(
        &self,
        select: &ast::Select,
        items: &[Item],
        names: &[String],
        binder: &Binder,
    ) -> Answer<Vec<Key>> {
        let written: Vec<ast::Expr> = match &select.group_by {
            ast::GroupByExpr::Expressions(written, modifiers) if modifiers.is_empty() => written.clone(),
            ast::GroupByExpr::All(modifiers) if modifiers.is_empty() => {
                items.iter().map(Item::expr).filter(|expr| !has_aggregate(expr)).collect()
            }
            _ => {
                return refuse!(
                    "ROLLUP, CUBE and TOTALS are not supported; combine several queries with UNION ALL"
                );
            }
        };
        let mut keys = Vec::with_capacity(written.len());
        for written in written {
            let written = match placed(OrderKey::Written(Box::new(written)), items, &[])? {
                OrderKey::Place(place) => items[place].expr(),
                OrderKey::Written(expr) => *expr,
            };
            // An alias of SELECT stands for its expression, which is then the key.
            let named = match &written {
                ast::Expr::Identifier(name)
                    if resolve(binder.columns, std::slice::from_ref(name)).is_err() =>
                {
                    names.iter().position(|other| same(other, &name.value)).map(|place| items[place].expr())
                }
                _ => None,
            };
            let written = named.unwrap_or(written);
            let value = binder.bind(&written)?;
            keys.push(Key { written, value, id: self.fresh() });
        }
        Ok(keys)
    }

    /// Plans a subquery. `around` are the columns of the outer query, which messages mention but a subquery can't use.
    fn subquery(&self, query: &ast::Query, ctes: &Ctes, around: &[Column]) -> Answer<Relation> {
        self.around.borrow_mut().push(around.to_vec());
        let relation = self.query(query, ctes);
        self.around.borrow_mut().pop();
        relation
    }

    /// Plans a subquery with one column. Returns the column under the name `value`, and its type.
    fn column(&self, query: &ast::Query, ctes: &Ctes, around: &[Column]) -> Answer<(LazyFrame, Type)> {
        let relation = self.subquery(query, ctes, around)?;
        match relation.columns.as_slice() {
            [column] => Ok((relation.frame.select([col(&*column.id).alias("value")]), column.kind)),
            columns => {
                refuse!("the subquery '{}' gives {} columns instead of one", shown(query), columns.len())
            }
        }
    }
}

impl Planning for Planner<'_> {
    fn fresh(&self) -> String {
        self.names.set(self.names.get() + 1);
        format!("#{}", self.names.get())
    }

    fn can_copy(&self, condition: &Expr) -> bool {
        let parts = self.condition_parts.get() + condition.into_iter().count();
        self.condition_parts.set(parts);
        parts <= MAX_CONDITION_PARTS
    }

    fn around(&self, path: &[ast::Ident]) -> bool {
        self.around.borrow().iter().any(|columns| resolve(columns, path).is_ok())
    }

    fn scalar(&self, query: &ast::Query, ctes: &Ctes, around: &[Column]) -> Answer<Value> {
        let (frame, kind) = self.column(query, ctes, around)?;
        let rows = frame.limit(2).collect()?;
        let values = rows.column("value")?;
        match values.len() {
            0 => Ok(Value::null(kind)),
            1 => Ok(Value::literal(values.get(0)?, kind)),
            _ => refuse!(
                "the subquery '{}' gives several rows instead of one value; use IN, or an aggregate such as max",
                shown(query)
            ),
        }
    }

    fn list(&self, query: &ast::Query, ctes: &Ctes, around: &[Column]) -> Answer<Vec<Value>> {
        let (frame, kind) = self.column(query, ctes, around)?;
        let rows = frame.unique_stable(None, UniqueKeepStrategy::First).collect()?;
        let values = rows.column("value")?;
        (0..values.len()).map(|row| Ok(Value::literal(values.get(row)?, kind))).collect()
    }

    fn exists(&self, query: &ast::Query, ctes: &Ctes, around: &[Column]) -> Answer<bool> {
        let relation = self.subquery(query, ctes, around)?;
        Ok(relation.frame.limit(1).collect()?.height() > 0)
    }
}

impl Item<'_> {
    fn expr(&self) -> ast::Expr {
        match self {
            Item::Written(expr) => (*expr).clone(),
            Item::Column(column) => {
                let path =
                    column.table.iter().chain([&column.name]).map(|name| ast::Ident::new(name.as_str()));
                ast::Expr::CompoundIdentifier(path.collect())
            }
        }
    }
}

/// A key of ORDER BY or GROUP BY.
enum OrderKey {
    /// An expression.
    Written(Box<ast::Expr>),
    /// A column of the answer, counted from 0.
    Place(usize),
}

/// The keys of ORDER BY. Each has two flags: whether it is descending, and whether nulls come last.
fn order_keys(order_by: &ast::OrderBy, outputs: usize) -> Answer<Vec<(OrderKey, (bool, bool))>> {
    none_of(&[(order_by.interpolate.is_some(), "INTERPOLATE", "leave it out")])?;
    let all = |options: &ast::OrderByOptions| {
        let options = options_of(options);
        (0..outputs).map(|place| (OrderKey::Place(place), options)).collect()
    };
    match &order_by.kind {
        ast::OrderByKind::All(options) => Ok(all(options)),
        ast::OrderByKind::Expressions(keys) => match keys.as_slice() {
            [ast::OrderByExpr { expr: ast::Expr::Identifier(name), options, with_fill: None }]
                if name.quote_style.is_none() && same(&name.value, "all") =>
            {
                Ok(all(options))
            }
            keys => keys
                .iter()
                .map(|key| Ok((OrderKey::Written(Box::new(key.expr.clone())), direction(key)?)))
                .collect(),
        },
    }
}

/// Resolves a key that is the number of an item or one of `names` to the item's position. Other keys are returned
/// unchanged.
fn placed(key: OrderKey, items: &[Item], names: &[String]) -> Answer<OrderKey> {
    let OrderKey::Written(written) = key else {
        return Ok(key);
    };
    match written.as_ref() {
        ast::Expr::Value(ast::ValueWithSpan { value: ast::Value::Number(digits, _), .. }) => {
            match digits.parse::<usize>() {
                Ok(number) if (1..=items.len()).contains(&number) => Ok(OrderKey::Place(number - 1)),
                _ => refuse!("SELECT has no column {digits}; its columns are 1 to {}", items.len()),
            }
        }
        ast::Expr::Identifier(name) => {
            let places: Vec<usize> =
                (0..names.len()).filter(|&place| same(&names[place], &name.value)).collect();
            match places.as_slice() {
                [] => Ok(OrderKey::Written(written)),
                [first, rest @ ..]
                    if rest.iter().all(|place| items[*place].expr() == items[*first].expr()) =>
                {
                    Ok(OrderKey::Place(*first))
                }
                _ => refuse!("several columns of SELECT are named '{}'; order by their number", name.value),
            }
        }
        _ => Ok(OrderKey::Written(written)),
    }
}

/// Groups rows: one row for each group, or one row in total without keys.
fn aggregated(frame: LazyFrame, groups: Groups) -> LazyFrame {
    let Groups { keys, arguments, mut aggregates } = groups;
    let key_columns = keys.iter().map(|key| key.value.expr.clone().alias(&*key.id));
    let frame = frame.with_columns(key_columns.chain(arguments).collect::<Vec<_>>());
    if !keys.is_empty() {
        let keys: Vec<Expr> = keys.iter().map(|key| col(&*key.id)).collect();
        return frame.group_by_stable(keys).agg(aggregates);
    }
    // With HAVING there may be no aggregate, but there is one group all the same.
    aggregates.push(len().alias(""));
    frame.select(aggregates)
}

fn limited(relation: Relation, limit: Option<&ast::LimitClause>) -> Answer<Relation> {
    let (limit, offset) = match limit {
        None => return Ok(relation),
        Some(ast::LimitClause::LimitOffset { limit, offset, limit_by }) => {
            none_of(&[(!limit_by.is_empty(), "LIMIT … BY", "use row_number")])?;
            (limit.as_ref(), offset.as_ref().map(|offset| &offset.value))
        }
        Some(ast::LimitClause::OffsetCommaLimit { offset, limit }) => (Some(limit), Some(offset)),
    };
    let count = |expr: &ast::Expr| match expr.to_string().parse::<u32>() {
        Ok(count) => Ok(count),
        Err(_) => refuse!("LIMIT and OFFSET take whole numbers, not '{}'", shown(expr)),
    };
    let offset = offset.map_or(Ok(0), count)?;
    let limit = limit.map_or(Ok(IdxSize::MAX), count)?;
    Ok(Relation { frame: relation.frame.slice(offset.into(), limit), ..relation })
}

/// Refuses the parts of SELECT that are not supported.
fn check_select(select: &ast::Select) -> Answer<()> {
    let ast::Select {
        select_token: _,
        optimizer_hints: _,
        distinct: _,
        select_modifiers,
        top,
        top_before_distinct: _,
        projection,
        exclude,
        into,
        from: _,
        lateral_views,
        prewhere,
        selection: _,
        connect_by,
        group_by: _,
        cluster_by,
        distribute_by,
        sort_by,
        having: _,
        named_window: _,
        qualify: _,
        window_before_qualify: _,
        value_table_mode,
        flavor: _,
    } = select;
    none_of(&[
        (select_modifiers.is_some(), "what follows SELECT", "leave it out"),
        (top.is_some(), "TOP", "use LIMIT"),
        (projection.is_empty(), "FROM without SELECT", "write SELECT * FROM"),
        (exclude.is_some(), "EXCLUDE", "name the columns"),
        (into.is_some(), "INTO", "use --output"),
        (!lateral_views.is_empty(), "LATERAL VIEW", "use a join"),
        (prewhere.is_some(), "PREWHERE", "use WHERE"),
        (!connect_by.is_empty(), "CONNECT BY", "use a join"),
        (
            !cluster_by.is_empty() || !distribute_by.is_empty() || !sort_by.is_empty(),
            "CLUSTER BY, DISTRIBUTE BY and SORT BY",
            "use ORDER BY",
        ),
        (value_table_mode.is_some(), "SELECT AS", "name the columns"),
    ])
}
