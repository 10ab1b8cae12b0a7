//! Translates expressions from the parser's tree to Polars expressions with the meaning that standard SQL gives them.

use super::functions::{self, Aggregate};
use super::scope::{Column, Ctes, Type, Unresolved, resolve, same};
use super::syntax::{can_fail, inner, is_operand, is_plain};
use super::value::{Value, common};
use super::{Answer, SqlError, shown};
use polars::prelude::*;
use sqlparser::ast::{self, BinaryOperator, UnaryOperator};
use std::cell::RefCell;

/// The keys and aggregates of a grouped SELECT. Aggregates are added while expressions are bound.
pub struct Groups {
    /// The keys of GROUP BY.
    pub keys: Vec<Key>,
    /// The arguments of the aggregates, computed before grouping.
    pub arguments: Vec<Expr>,
    /// The aggregates of the arguments.
    pub aggregates: Vec<Expr>,
}

/// A key of GROUP BY.
pub struct Key {
    /// The key as the query has it.
    pub written: ast::Expr,
    /// The key's value in each row.
    pub value: Value,
    /// The id of the key's column in the grouped frame.
    pub id: String,
}

/// The aliases of SELECT, with their expressions.
pub type Aliases<'a> = &'a [(String, &'a ast::Expr)];

/// The rows in which the value of an expression is needed. Polars computes it in all rows.
#[derive(Clone, Copy)]
pub enum Needed<'a> {
    /// In every row.
    Always,
    /// Where a condition is true, such as in a branch of CASE. An operation that fails in another row is no error.
    Where(&'a Expr),
    /// An operation that fails gives null.
    Lenient,
}

/// A function call with OVER.
pub struct Call<'a> {
    /// The function's name, in lower case.
    pub name: &'a str,
    /// The arguments, without `*`.
    pub arguments: &'a [&'a ast::Expr],
    /// Whether the call has DISTINCT.
    pub distinct: bool,
    /// The condition of FILTER.
    pub filter: Option<&'a ast::Expr>,
}

/// What expressions need of the planner of their query: new ids, and the values of subqueries.
pub trait Planning {
    /// A new unique id for a column.
    fn fresh(&self) -> String;

    /// Counts the parts of a condition of CASE that is to be copied. Returns whether there are not too many.
    fn can_copy(&self, condition: &Expr) -> bool;

    /// Whether `path` names a column of a query that contains the current subquery.
    fn around(&self, path: &[ast::Ident]) -> bool;

    /// Computes a subquery of one value. The value is null if the subquery has no rows.
    fn scalar(&self, query: &ast::Query, ctes: &Ctes, around: &[Column]) -> Answer<Value>;

    /// Computes the distinct values of a subquery with one column.
    fn list(&self, query: &ast::Query, ctes: &Ctes, around: &[Column]) -> Answer<Vec<Value>>;

    /// Computes whether a subquery has rows.
    fn exists(&self, query: &ast::Query, ctes: &Ctes, around: &[Column]) -> Answer<bool>;
}

/// The window functions of a clause.
pub trait Windows {
    /// Binds a call with OVER, and keeps the columns that compute it.
    fn add(&self, binder: &Binder, call: &Call, over: &ast::WindowType) -> Answer<Value>;
}

/// Binds the expressions of one clause: resolves names, checks types, and returns Polars expressions.
#[derive(Clone, Copy)]
pub struct Binder<'a> {
    /// The planner of the query, for subqueries and new ids.
    pub planner: &'a dyn Planning,
    /// The queries of WITH that subqueries may name.
    pub ctes: &'a Ctes,
    /// The columns that the clause may name.
    pub columns: &'a [Column],
    /// The clause's name in messages, such as `WHERE`.
    pub clause: &'a str,
    /// The groups, if the clause is evaluated for groups instead of rows.
    pub groups: Option<&'a RefCell<Groups>>,
    /// The window functions found so far; `None` if the clause can't contain any.
    pub windows: Option<&'a dyn Windows>,
    /// The windows of the clause WINDOW.
    pub named_windows: &'a [ast::NamedWindowDefinition],
    /// The aliases of SELECT that the clause may name.
    pub aliases: Aliases<'a>,
    /// The rows in which the values are needed.
    pub needed: Needed<'a>,
}

impl<'a> Binder<'a> {
    /// Binds an expression.
    pub fn bind(&self, expr: &ast::Expr) -> Answer<Value> {
        if let Some(key) = self.group_key(expr) {
            return Ok(key);
        }
        self.unfolded(expr)?.folded()
    }

    /// Binds a condition, whose values must be true, false or null.
    pub fn condition(&self, expr: &ast::Expr) -> Answer<Expr> {
        let value = self.bind(expr)?;
        match value.kind {
            Type::Flag | Type::Null => Ok(value.to(Type::Flag)),
            other => refuse!("'{}' is {}, not a condition", shown(expr), other.name()),
        }
    }

    /// A binder for the rows before they are grouped.
    fn rows(&self) -> Self {
        Self { groups: None, windows: None, aliases: &[], needed: Needed::Always, ..*self }
    }

    /// A binder for values that are only needed where `condition` is true.
    fn only<'b>(&self, condition: &'b Expr) -> Binder<'b>
    where
        'a: 'b,
    {
        Binder { needed: Needed::Where(condition), ..*self }
    }

    /// A condition that is true in the rows in which the values are needed.
    fn where_needed(&self) -> Expr {
        match self.needed {
            Needed::Where(condition) => condition.clone(),
            Needed::Always | Needed::Lenient => lit(true),
        }
    }

    /// Computes an operation on `value` that fails for some values. It is an error only in rows in which the result is
    /// needed. The second argument of `operation` is whether a failure is an error.
    fn fallible(&self, value: Value, operation: impl Fn(Value, bool) -> Answer<Value>) -> Answer<Value> {
        let condition = match self.needed {
            Needed::Always => return operation(value, true),
            Needed::Lenient => return operation(value, false),
            Needed::Where(condition) => condition,
        };
        // The result of constants that do not fail is a constant.
        if let Ok(folded) = operation(value.clone(), true)?.folded()
            && folded.constant().is_some()
        {
            return Ok(folded);
        }
        if !self.planner.can_copy(condition) {
            return operation(value, true);
        }
        let masked = when(condition.clone()).then(value.expr).otherwise(Value::null(value.kind).expr);
        operation(Value::new(masked, value.kind), true)
    }

    /// The column of the GROUP BY key that `expr` is equal to, if there is one.
    fn group_key(&self, expr: &ast::Expr) -> Option<Value> {
        let groups = self.groups?.borrow();
        let written = inner(expr);
        let key = groups.keys.iter().find(|key| key.written == *written).or_else(|| {
            let row = if is_plain(written) { self.rows().bind(written).ok()? } else { return None };
            groups.keys.iter().find(|key| row.constant().is_none() && key.value.expr == row.expr)
        })?;
        Some(Value::column(&key.id, key.value.kind))
    }

    /// Binds an expression without evaluating constants.
    fn unfolded(&self, expr: &ast::Expr) -> Answer<Value> {
        use ast::Expr as E;
        let flag = |expr| Ok(Value::new(expr, Type::Flag));
        let negate = |value: Expr, negated: bool| if negated { value.not() } else { value };
        match expr {
            E::Identifier(name) => self.column(std::slice::from_ref(name)),
            E::CompoundIdentifier(path) => self.column(path),
            E::Nested(expr) => self.bind(expr),
            E::Value(value) => literal(&value.value),
            E::UnaryOp { op, expr } => self.unary(*op, expr),
            E::BinaryOp { left, op, right } => self.binary(left, op, right, expr),
            E::IsNull(expr) => flag(self.bind(expr)?.expr.is_null()),
            E::IsNotNull(expr) => flag(self.bind(expr)?.expr.is_not_null()),
            E::IsTrue(expr) => flag(self.condition(expr)?.eq_missing(lit(true))),
            E::IsNotTrue(expr) => flag(self.condition(expr)?.neq_missing(lit(true))),
            E::IsFalse(expr) => flag(self.condition(expr)?.eq_missing(lit(false))),
            E::IsNotFalse(expr) => flag(self.condition(expr)?.neq_missing(lit(false))),
            E::IsUnknown(expr) => flag(self.condition(expr)?.is_null()),
            E::IsNotUnknown(expr) => flag(self.condition(expr)?.is_not_null()),
            E::IsDistinctFrom(left, right) | E::IsNotDistinctFrom(left, right) => {
                // The parser reads `a IS DISTINCT FROM b AND c` as `a IS DISTINCT FROM (b AND c)`.
                if !is_operand(right) {
                    return refuse!("'{}' is ambiguous; add parentheses", shown(expr));
                }
                let (left, right) = self.pair(left, right, expr)?;
                let is_distinct = left.neq_missing(right);
                flag(negate(is_distinct, matches!(expr, E::IsNotDistinctFrom(..))))
            }
            E::Between { expr: value, negated, low, high } => {
                let (value_low, low) = self.pair(value, low, expr)?;
                let (value_high, high) = self.pair(value, high, expr)?;
                flag(negate(value_low.gt_eq(low).and(value_high.lt_eq(high)), *negated))
            }
            E::InList { expr: value, list, negated } => {
                let value = self.side(value)?;
                let list = list.iter().map(|item| self.side(item)).collect::<Answer<Vec<_>>>()?;
                flag(negate(membership(&value, list, expr)?, *negated))
            }
            E::InSubquery { expr: value, subquery, negated } => {
                let value = self.bind(value)?;
                let list = self.planner.list(subquery, self.ctes, self.columns)?;
                flag(negate(membership(&value, list, expr)?, *negated))
            }
            E::Exists { subquery, negated } => {
                let exists = self.planner.exists(subquery, self.ctes, self.columns)?;
                Ok(Value::literal(AnyValue::Boolean(exists != *negated), Type::Flag))
            }
            E::Subquery(query) => self.planner.scalar(query, self.ctes, self.columns),
            E::Like { negated, any: false, expr: value, pattern, escape_char: None } => {
                flag(negate(self.like(value, pattern, "(?s)")?, *negated))
            }
            E::ILike { negated, any: false, expr: value, pattern, escape_char: None } => {
                flag(negate(self.like(value, pattern, "(?is)")?, *negated))
            }
            E::Like { .. } | E::ILike { .. } => refuse!("LIKE with ESCAPE or ANY is not supported"),
            E::SimilarTo { .. } | E::RLike { .. } => {
                refuse!("'{}' is not supported; use LIKE, with % for any text", shown(expr))
            }
            E::Case { operand, conditions, else_result, .. } => {
                self.case(operand.as_deref(), conditions, else_result.as_deref(), expr)
            }
            E::Cast { kind, expr: value, data_type, format: None, array: false } => {
                self.cast(kind, value, data_type)
            }
            E::Function(function) => self.function(function),
            E::Ceil { expr, field: ast::CeilFloorKind::DateTimeField(ast::DateTimeField::NoDateTime) } => {
                functions::call("ceil", vec![self.bind(expr)?], true)
            }
            E::Floor { expr, field: ast::CeilFloorKind::DateTimeField(ast::DateTimeField::NoDateTime) } => {
                functions::call("floor", vec![self.bind(expr)?], true)
            }
            E::Substring { expr, substring_from, substring_for, shorthand, .. } => {
                let start = match substring_from {
                    Some(start) => self.bind(start)?,
                    None => Value::literal(AnyValue::Int64(1), Type::Integer),
                };
                let mut parts = vec![self.bind(expr)?, start];
                if let Some(count) = substring_for {
                    parts.push(self.bind(count)?);
                }
                functions::call(if *shorthand { "substr" } else { "substring" }, parts, true)
            }
            E::Trim { .. } => functions::call("trim", Vec::new(), true),
            E::Tuple(_) => {
                refuse!("'{}' compares several columns at once; compare each with AND, or join", shown(expr))
            }
            E::AnyOp { .. } | E::AllOp { .. } => {
                refuse!("'{}' is not supported; use IN, or compare with max or min", shown(expr))
            }
            E::Interval(_) | E::Extract { .. } | E::TypedString(_) | E::AtTimeZone { .. } => {
                functions::no_dates(&shown(expr))
            }
            E::GroupingSets(_) | E::Cube(_) | E::Rollup(_) => refuse!(
                "ROLLUP, CUBE and GROUPING SETS are not supported; combine several queries with UNION ALL"
            ),
            other => refuse!("'{}' is not supported", shown(other)),
        }
    }

    fn column(&self, path: &[ast::Ident]) -> Answer<Value> {
        let found = match resolve(self.columns, path) {
            Ok(column) => column,
            Err(Unresolved::Ambiguous(message)) => return Err(SqlError::Refused(message)),
            Err(Unresolved::Unknown(message)) => {
                if let [name] = path
                    && let Some((_, written)) =
                        self.aliases.iter().find(|(alias, _)| same(alias, &name.value))
                {
                    return Self { aliases: &[], ..*self }.bind(written);
                }
                return Err(SqlError::Refused(self.unknown(path, message)));
            }
        };
        if self.groups.is_some() {
            return refuse!(
                "'{name}' must be in GROUP BY or in an aggregate, such as max({name})",
                name = found.name
            );
        }
        Ok(Value::column(&found.id, found.kind))
    }

    /// The message about an unknown name, with the reason if it is a known mistake. `message` is used otherwise.
    fn unknown(&self, path: &[ast::Ident], message: String) -> String {
        let name = path.iter().map(|part| part.value.as_str()).collect::<Vec<_>>().join(".");
        if self.planner.around(path) {
            return format!(
                "'{name}' is a column of the outer query, which a subquery can't use; write a join instead"
            );
        }
        match path {
            [one] if one.quote_style == Some('"') => {
                format!("{message}. Write text in single quotes: '{name}'")
            }
            _ => message,
        }
    }

    fn unary(&self, op: UnaryOperator, expr: &ast::Expr) -> Answer<Value> {
        match op {
            UnaryOperator::Not => Ok(Value::new(self.condition(expr)?.not(), Type::Flag)),
            UnaryOperator::Plus | UnaryOperator::Minus => {
                let value = self.bind(expr)?.for_computing();
                if !value.kind.is_number() {
                    return refuse!("'{}' is {}, not a number", shown(expr), value.kind.name());
                }
                if op == UnaryOperator::Plus {
                    return Ok(value);
                }
                let zero = match value.kind {
                    // 0 - 0.0 is 0.0 instead of -0.0.
                    Type::Real => return Ok(Value::new(value.expr * lit(-1.0), Type::Real)),
                    _ => Value::literal(AnyValue::Int64(0), Type::Integer),
                };
                self.fallible(value, |value, strict| functions::arithmetic(zero.clone(), '-', value, strict))
            }
            other => refuse!("the operator {other} is not supported"),
        }
    }

    fn binary(
        &self,
        left: &ast::Expr,
        op: &BinaryOperator,
        right: &ast::Expr,
        whole: &ast::Expr,
    ) -> Answer<Value> {
        use BinaryOperator as B;
        let compared = |op: fn(Expr, Expr) -> Expr| -> Answer<Value> {
            let (left, right) = self.pair(left, right, whole)?;
            Ok(Value::new(op(left, right), Type::Flag))
        };
        match op {
            B::And => Ok(Value::new(self.condition(left)?.and(self.condition(right)?), Type::Flag)),
            B::Or => Ok(Value::new(self.condition(left)?.or(self.condition(right)?), Type::Flag)),
            B::Eq => compared(Expr::eq),
            B::NotEq => compared(Expr::neq),
            B::Lt => compared(Expr::lt),
            B::LtEq => compared(Expr::lt_eq),
            B::Gt => compared(Expr::gt),
            B::GtEq => compared(Expr::gt_eq),
            B::Plus | B::Minus | B::Multiply | B::Divide | B::Modulo => {
                let sign = op.to_string().chars().next().unwrap_or_default();
                let (left_value, right_value) = (self.bind(left)?, self.bind(right)?);
                for (value, expr) in [(&left_value, left), (&right_value, right)] {
                    if !value.kind.is_number() {
                        return refuse!(
                            "'{}' can't be computed: '{}' is {}",
                            shown(whole),
                            shown(expr),
                            value.kind.name()
                        );
                    }
                }
                self.fallible(left_value, |left, strict| {
                    functions::arithmetic(left, sign, right_value.clone(), strict)
                })
            }
            B::StringConcat => {
                let parts = [self.bind(left)?, self.bind(right)?];
                let [left, right] = parts.map(functions::text);
                Ok(Value::new(left?.expr + right?.expr, Type::Text))
            }
            B::DuckIntegerDivide => refuse!("the operator // is not supported; use floor(a / b)"),
            other => refuse!("the operator {other} is not supported"),
        }
    }

    /// Binds two expressions to compare, and converts them to their common type.
    fn pair(&self, left: &ast::Expr, right: &ast::Expr, whole: &ast::Expr) -> Answer<(Expr, Expr)> {
        let (left, right) = (self.side(left)?, self.side(right)?);
        let kind = match common_in([&left, &right], whole)? {
            // Polars can't compare nulls without a type.
            Type::Null => Type::Flag,
            kind => kind,
        };
        Ok((left.to(kind), right.to(kind)))
    }

    /// Binds a side of a comparison. A name there that no column has was probably meant as a text.
    fn side(&self, expr: &ast::Expr) -> Answer<Value> {
        let is_text = |name: &ast::Ident| {
            let path = std::slice::from_ref(name);
            let is_unknown = matches!(resolve(self.columns, path), Err(Unresolved::Unknown(_)))
                && !self.aliases.iter().any(|(alias, _)| same(alias, &name.value));
            is_unknown && name.quote_style.is_none() && !self.planner.around(path)
        };
        self.bind(expr).map_err(|error| match (expr, error) {
            (ast::Expr::Identifier(name), SqlError::Refused(message)) if is_text(name) => {
                SqlError::Refused(format!("{message}. Write text in single quotes: '{}'", name.value))
            }
            (_, error) => error,
        })
    }

    fn like(&self, value: &ast::Expr, pattern: &ast::Expr, flags: &str) -> Answer<Expr> {
        let (text, pattern) = (self.bind(value)?, self.bind(pattern)?);
        if !matches!(text.kind, Type::Text | Type::Null) {
            return refuse!("LIKE takes text, but '{}' is {}", shown(value), text.kind.name());
        }
        match pattern.constant() {
            Some(AnyValue::Null) => Ok(Value::null(Type::Flag).expr),
            Some(AnyValue::StringOwned(pattern)) => {
                Ok(text.to(Type::Text).str().contains(lit(regex(&pattern, flags)), true))
            }
            _ => refuse!("LIKE takes a text in quotes as its pattern"),
        }
    }

    fn case(
        &self,
        operand: Option<&ast::Expr>,
        conditions: &[ast::CaseWhen],
        otherwise: Option<&ast::Expr>,
        whole: &ast::Expr,
    ) -> Answer<Value> {
        let bound = |binder: &Binder<'_>, condition: &ast::Expr| match operand {
            None => binder.condition(condition),
            Some(operand) => {
                let (operand, wanted) = binder.pair(operand, condition, whole)?;
                Ok(operand.eq(wanted))
            }
        };
        // A part is only computed where the conditions before it are not true, and a result only where its condition
        // is.
        let is_guarded = !matches!(self.needed, Needed::Lenient) && can_fail(whole);
        let mut reached = self.where_needed();
        let mut branches = Vec::with_capacity(conditions.len());
        for ast::CaseWhen { condition, result } in conditions {
            if !is_guarded {
                branches.push((bound(self, condition)?, self.bind(result)?));
                continue;
            }
            let is_true = bound(&Self { needed: Needed::Lenient, ..*self }, condition)?;
            let chosen = reached.clone().and(is_true.clone().eq_missing(lit(true)));
            branches.push((bound(&self.only(&reached), condition)?, self.only(&chosen).bind(result)?));
            reached = reached.and(is_true.neq_missing(lit(true)));
        }
        let last = if is_guarded { self.only(&reached) } else { *self };
        let otherwise = otherwise.map_or(Ok(Value::null(Type::Null)), |expr| last.bind(expr))?;
        let results = branches.iter().map(|(_, result)| result).chain([&otherwise]);
        let kind = common_in(results, whole)?;
        let branches = branches.into_iter().rev();
        let chosen = branches.fold(otherwise.to(kind), |rest, (condition, result)| {
            when(condition).then(result.to(kind)).otherwise(rest)
        });
        Ok(Value::new(chosen, kind))
    }

    fn cast(&self, kind: &ast::CastKind, expr: &ast::Expr, data_type: &ast::DataType) -> Answer<Value> {
        use ast::{DataType as D, ExactNumberInfo};
        let value = self.bind(expr)?.for_computing();
        let strict = matches!(kind, ast::CastKind::Cast | ast::CastKind::DoubleColon);
        match data_type {
            D::Int(None) | D::Integer(None) => self.fallible(value, |value, is_error| {
                functions::to_integer(value, expr, strict && is_error, i32::MIN.into(), i32::MAX.into())
            }),
            D::BigInt(None) => self.fallible(value, |value, is_error| {
                functions::to_integer(value, expr, strict && is_error, i64::MIN, i64::MAX)
            }),
            D::Double(ExactNumberInfo::None) | D::DoublePrecision => {
                self.fallible(value, |value, is_error| functions::to_real(value, strict && is_error))
            }
            D::Varchar(None) | D::Text | D::String(None) => functions::text(value),
            D::Boolean | D::Bool => match value.kind {
                Type::Flag | Type::Null => Ok(Value::new(value.to(Type::Flag), Type::Flag)),
                Type::Integer => Ok(Value::new(value.expr.neq(lit(0)), Type::Flag)),
                other => refuse!("{} can't be cast to boolean; compare it instead", other.name()),
            },
            D::Date | D::Time(..) | D::Timestamp(..) | D::Datetime(_) => {
                functions::no_dates(&data_type.to_string())
            }
            other => {
                refuse!("the type {other} is not supported; use INTEGER, BIGINT, DOUBLE, VARCHAR or BOOLEAN")
            }
        }
    }

    fn function(&self, function: &ast::Function) -> Answer<Value> {
        let ast::Function {
            name,
            uses_odbc_syntax: _,
            parameters,
            args,
            filter,
            null_treatment,
            over,
            within_group,
        } = function;
        let name = name.to_string().to_lowercase();
        let plain = matches!(parameters, ast::FunctionArguments::None)
            && null_treatment.is_none()
            && within_group.is_empty();
        let ast::FunctionArguments::List(list) = args else {
            return refuse!("'{}' is not supported", shown(function));
        };
        if !plain || !list.clauses.is_empty() {
            return refuse!(
                "'{}' is not supported: a function takes only arguments, DISTINCT, FILTER and OVER",
                shown(function)
            );
        }
        let distinct = matches!(list.duplicate_treatment, Some(ast::DuplicateTreatment::Distinct));
        let arguments = list.args.iter().map(|argument| match argument {
            ast::FunctionArg::Unnamed(ast::FunctionArgExpr::Expr(expr)) => Ok(Some(expr)),
            ast::FunctionArg::Unnamed(ast::FunctionArgExpr::Wildcard) if name == "count" => Ok(None),
            other => refuse!("'{other}' can't be an argument of {name}"),
        });
        // `*` counts as no argument.
        let arguments: Vec<&ast::Expr> =
            arguments.collect::<Answer<Vec<_>>>()?.into_iter().flatten().collect();
        if let Some(over) = over {
            let call = Call { name: &name, arguments: &arguments, distinct, filter: filter.as_deref() };
            return match self.windows {
                Some(windows) => windows.add(self, &call, over),
                None => refuse!(
                    "'{}' can't be in {}; compute it in a query of its own, with WITH",
                    shown(function),
                    self.clause
                ),
            };
        }
        if Aggregate::is_name(&name) {
            return self.aggregate(&name, &arguments, distinct, filter.as_deref(), function);
        }
        if distinct || filter.is_some() {
            return refuse!("DISTINCT and FILTER are only for aggregates, and {name} is not one");
        }
        if functions::OVER_ORDER.contains(&&*name) {
            return refuse!("{name} needs OVER (ORDER BY …)");
        }
        functions::check_name(&name)?;
        if name == "coalesce" {
            return functions::call(&name, self.alternatives(&arguments)?, true);
        }
        let mut arguments = arguments.into_iter().map(|expr| self.bind(expr)).collect::<Answer<Vec<_>>>()?;
        if !functions::FALLIBLE.contains(&&*name) || arguments.is_empty() {
            return functions::call(&name, arguments, true);
        }
        let first = arguments.remove(0);
        self.fallible(first, |first, strict| {
            functions::call(&name, [vec![first], arguments.clone()].concat(), strict)
        })
    }

    /// Binds the arguments of `coalesce`. Each is only computed where those before it are null.
    fn alternatives(&self, arguments: &[&ast::Expr]) -> Answer<Vec<Value>> {
        if matches!(self.needed, Needed::Lenient) || !arguments.iter().any(|expr| can_fail(expr)) {
            return arguments.iter().map(|expr| self.bind(expr)).collect();
        }
        let mut reached = self.where_needed();
        let mut values = Vec::with_capacity(arguments.len());
        for expr in arguments {
            values.push(self.only(&reached).bind(expr)?);
            let value = Self { needed: Needed::Lenient, ..*self }.bind(expr)?;
            reached = reached.and(value.expr.is_null());
        }
        Ok(values)
    }

    fn aggregate(
        &self,
        name: &str,
        arguments: &[&ast::Expr],
        distinct: bool,
        filter: Option<&ast::Expr>,
        written: &ast::Function,
    ) -> Answer<Value> {
        let Some(groups) = self.groups else {
            return Err(SqlError::Refused(match self.clause {
                "WHERE" => format!("'{}' can't be in WHERE; use HAVING", shown(written)),
                clause => format!(
                    "'{}' can't be in {clause}; compute it in a query of its own, with WITH",
                    shown(written)
                ),
            }));
        };
        let inside = Self { clause: "an aggregate", ..self.rows() };
        if matches!(name, "arg_min" | "arg_max") {
            return inside.value_at(name, arguments, filter, groups);
        }
        let (aggregate, argument) = inside.argument(name, arguments, filter)?;
        let (argument_id, id) = (self.planner.fresh(), self.planner.fresh());
        let (expr, kind) = aggregate.of(&argument_id, argument.kind, distinct)?;
        let mut groups = groups.borrow_mut();
        groups.arguments.push(argument.expr.alias(&argument_id));
        groups.aggregates.push(expr.alias(&id));
        let value = Value::column(&id, kind);
        if aggregate != Aggregate::Sum || kind != Type::Integer {
            return Ok(value);
        }
        // Polars' sum of integers wraps around without an error. The sum of real numbers shows when it did.
        let real = self.planner.fresh();
        let (sum, _) = aggregate.of(&argument_id, Type::Real, distinct)?;
        groups.aggregates.push(sum.alias(&real));
        Ok(functions::sum_within_integers(value, col(&*real)))
    }

    /// The aggregate `arg_min` or `arg_max`, which is computed from two columns.
    fn value_at(
        &self,
        name: &str,
        arguments: &[&ast::Expr],
        filter: Option<&ast::Expr>,
        groups: &RefCell<Groups>,
    ) -> Answer<Value> {
        let [value, by] = arguments else {
            return refuse!("{name} takes two values: the one to return, and the one to compare");
        };
        let value = self.filtered(self.bind(value)?.for_computing(), filter)?;
        let by = self.bind(by)?.for_computing();
        let [value_id, by_id, id] = [(); 3].map(|()| self.planner.fresh());
        let mut groups = groups.borrow_mut();
        groups.arguments.extend([value.expr.alias(&value_id), by.expr.alias(&by_id)]);
        groups.aggregates.push(functions::value_at(name, &value_id, &by_id).alias(&id));
        Ok(Value::column(&id, value.kind))
    }

    /// The aggregate that is called, and its argument, which is null in the rows that FILTER excludes.
    pub fn argument(
        &self,
        name: &str,
        arguments: &[&ast::Expr],
        filter: Option<&ast::Expr>,
    ) -> Answer<(Aggregate, Value)> {
        let values = arguments.iter().map(|expr| self.bind(expr)).collect::<Answer<Vec<_>>>()?;
        let values = values.into_iter().map(Value::for_computing).collect();
        let (aggregate, argument) = Aggregate::named(name, values)?;
        Ok((aggregate, self.filtered(argument, filter)?))
    }

    /// The value, which is null in the rows that FILTER excludes.
    fn filtered(&self, value: Value, filter: Option<&ast::Expr>) -> Answer<Value> {
        let Some(filter) = filter else { return Ok(value) };
        let kind = value.kind;
        let kept = when(self.condition(filter)?).then(value.expr).otherwise(Value::null(kind).expr);
        Ok(Value::new(kept, kind))
    }
}

/// The common type of `values`. `whole` is the expression that a message names if there is none.
fn common_in<'a>(values: impl IntoIterator<Item = &'a Value>, whole: &ast::Expr) -> Answer<Type> {
    let [one, other] = match common(values) {
        Ok(kind) => return Ok(kind),
        Err(kinds) => kinds,
    };
    let hint = match (one, other) {
        (Type::Text, Type::Integer | Type::Real) | (Type::Integer | Type::Real, Type::Text) => {
            "; write text in quotes, and numbers without"
        }
        _ => "",
    };
    refuse!("'{}' mixes {} with {}{hint}", shown(whole), one.name(), other.name())
}

/// The condition `value IN list`. It is null if `value` is not in the list and the list contains a null.
fn membership(value: &Value, list: Vec<Value>, whole: &ast::Expr) -> Answer<Expr> {
    if list.is_empty() {
        return Ok(lit(false));
    }
    let kind = common_in(list.iter().chain([value]), whole)?;
    let wanted = value.clone().to(kind);
    let mut constants = Vec::new();
    let mut found = lit(false);
    for item in list {
        match item.constant() {
            Some(constant) => constants.push(constant),
            None => found = found.or(wanted.clone().eq(item.to(kind))),
        }
    }
    let with_null = constants.iter().any(|constant| matches!(constant, AnyValue::Null));
    constants.retain(|constant| !matches!(constant, AnyValue::Null));
    if !constants.is_empty() {
        let constants = Series::from_any_values_and_dtype("".into(), &constants, &kind.data_type(), false)?;
        let among = wanted.clone().is_in(lit(constants).implode(true), false);
        found = found.or(when(wanted.is_null()).then(Value::null(Type::Flag).expr).otherwise(among));
    }
    Ok(if with_null { found.or(Value::null(Type::Flag).expr) } else { found })
}

fn literal(value: &ast::Value) -> Answer<Value> {
    match value {
        ast::Value::Number(digits, false) if digits.contains(['.', 'e', 'E']) => match digits.parse() {
            Ok(real) => Ok(Value::literal(AnyValue::Float64(real), Type::Real)),
            Err(_) => refuse!("'{digits}' is not a number"),
        },
        ast::Value::Number(digits, false) => match digits.parse() {
            Ok(integer) => Ok(Value::literal(AnyValue::Int64(integer), Type::Integer)),
            Err(_) => refuse!("'{digits}' is too large for an integer; write {digits}.0"),
        },
        ast::Value::SingleQuotedString(text) => {
            Ok(Value::literal(AnyValue::StringOwned(text.as_str().into()), Type::Text))
        }
        ast::Value::Boolean(flag) => Ok(Value::literal(AnyValue::Boolean(*flag), Type::Flag)),
        ast::Value::Null => Ok(Value::null(Type::Null)),
        other => refuse!("'{other}' is not supported"),
    }
}

/// Converts a pattern of LIKE to a regular expression.
fn regex(pattern: &str, flags: &str) -> String {
    let mut regex = format!("^{flags}");
    for letter in pattern.chars() {
        match letter {
            '%' => regex.push_str(".*"),
            '_' => regex.push('.'),
            letter => {
                if r"\.+*?()|[]{}^$#&-~".contains(letter) {
                    regex.push('\\');
                }
                regex.push(letter);
            }
        }
    }
    regex + "$"
}
