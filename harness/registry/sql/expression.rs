//! Expressions: from the parser's tree to Polars' expressions, with the standard's meaning.

use super::functions::{self, Aggregate};
use super::plan::{Ctes, Planner};
use super::scope::{Column, Type, Unresolved, resolve, same};
use super::window::Window;
use super::{Answer, refuse, shown};
use polars::prelude::*;
use sqlparser::ast::{self, BinaryOperator, UnaryOperator, Visit, Visitor};
use std::cell::RefCell;
use std::ops::ControlFlow;

/// An expression of Polars, and what it gives.
#[derive(Clone)]
pub struct Value {
    pub expr: Expr,
    pub kind: Type,
}

impl Value {
    pub fn new(expr: Expr, kind: Type) -> Self {
        Self { expr, kind }
    }

    /// A constant of the kind.
    pub fn literal(value: AnyValue, kind: Type) -> Self {
        Self::new(lit(Scalar::new(kind.data_type(), value.into_static())), kind)
    }

    pub fn null(kind: Type) -> Self {
        Self::literal(AnyValue::Null, kind)
    }

    pub fn column(id: &str, kind: Type) -> Self {
        Self::new(col(id), kind)
    }

    /// The constant that it is, if it is one.
    pub fn constant(&self) -> Option<AnyValue<'static>> {
        match &self.expr {
            Expr::Literal(LiteralValue::Scalar(scalar)) => Some(scalar.value().clone()),
            _ => None,
        }
    }

    /// The same as another type; one that [`Type::common`] gave, or the same.
    pub fn to(self, kind: Type) -> Expr {
        if self.kind == kind { self.expr } else { self.expr.cast(kind.data_type()) }
    }

    /// The same with 64 bits, if it is a real number of fewer.
    pub fn for_computing(self) -> Self {
        match self.kind {
            Type::Single => Self::new(self.to(Type::Real), Type::Real),
            _ => self,
        }
    }

    /// A constant instead of an expression without columns: Polars would treat it as a column of its own.
    pub fn folded(self) -> Answer<Self> {
        let has_columns = || (&self.expr).into_iter().any(|part| matches!(part, Expr::Column(_)));
        if matches!(self.expr, Expr::Literal(_)) || has_columns() {
            return Ok(self);
        }
        let one = one_row().select([self.expr.alias("value")]).collect()?;
        Ok(Self::literal(one.column("value")?.get(0)?, self.kind))
    }
}

/// A frame of one row, for queries without FROM.
pub fn one_row() -> LazyFrame {
    df!("" => [true]).expect("a frame of one column has no lengths to differ").lazy()
}

/// What is computed of each group, collected while expressions are bound.
pub struct Groups {
    pub keys: Vec<Key>,
    /// What the aggregates are of.
    pub arguments: Vec<Expr>,
    pub aggregates: Vec<Expr>,
}

/// What GROUP BY groups by.
pub struct Key {
    pub written: ast::Expr,
    pub value: Value,
    pub id: String,
}

/// Names given in SELECT, and what they stand for.
pub type Aliases<'a> = &'a [(String, &'a ast::Expr)];

/// Binds the expressions of one clause.
#[derive(Clone, Copy)]
pub struct Binder<'a> {
    pub planner: &'a Planner<'a>,
    pub ctes: &'a Ctes,
    pub columns: &'a [Column],
    /// As a message names the clause.
    pub clause: &'a str,
    /// The groups, if the clause sees groups instead of rows.
    pub groups: Option<&'a RefCell<Groups>>,
    /// The window functions, where there may be some.
    pub windows: Option<&'a RefCell<Vec<Window>>>,
    pub aliases: Aliases<'a>,
}

impl<'a> Binder<'a> {
    pub fn bind(&self, expr: &ast::Expr) -> Answer<Value> {
        if let Some(key) = self.group_key(expr) {
            return Ok(key);
        }
        self.unfolded(expr)?.folded()
    }

    /// A condition: true, false or null.
    pub fn condition(&self, expr: &ast::Expr) -> Answer<Expr> {
        let value = self.bind(expr)?;
        match value.kind {
            Type::Flag | Type::Null => Ok(value.to(Type::Flag)),
            other => refuse(format!("'{}' is {}, and a condition is wanted", shown(expr), other.name())),
        }
    }

    /// The same rows before they are grouped.
    fn rows(&self) -> Self {
        Self { groups: None, windows: None, aliases: &[], ..*self }
    }

    /// The key that `expr` is, if GROUP BY has it.
    fn group_key(&self, expr: &ast::Expr) -> Option<Value> {
        let groups = self.groups?.borrow();
        let written = inner(expr);
        let key = groups.keys.iter().find(|key| key.written == *written).or_else(|| {
            let row = if is_plain(written) { self.rows().bind(written).ok()? } else { return None };
            groups.keys.iter().find(|key| row.constant().is_none() && key.value.expr == row.expr)
        })?;
        Some(Value::column(&key.id, key.value.kind))
    }

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
                // The parser takes `a IS DISTINCT FROM b AND c` for `a IS DISTINCT FROM (b AND c)`.
                if !is_operand(right) {
                    return refuse(format!("what '{}' means is not clear; put brackets in it", shown(expr)));
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
                let value = self.bind(value)?;
                let list = list.iter().map(|item| self.bind(item)).collect::<Answer<Vec<_>>>()?;
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
            E::Like { .. } | E::ILike { .. } => refuse("LIKE has no ESCAPE and no ANY here".into()),
            E::SimilarTo { .. } | E::RLike { .. } => {
                refuse(format!("'{}' is not supported; use LIKE, with % for any text", shown(expr)))
            }
            E::Case { operand, conditions, else_result, .. } => {
                self.case(operand.as_deref(), conditions, else_result.as_deref(), expr)
            }
            E::Cast { kind, expr: value, data_type, format: None, array: false } => {
                self.cast(kind, value, data_type)
            }
            E::Function(function) => self.function(function),
            E::Ceil { expr, field: ast::CeilFloorKind::DateTimeField(ast::DateTimeField::NoDateTime) } => {
                functions::call("ceil", vec![self.bind(expr)?])
            }
            E::Floor { expr, field: ast::CeilFloorKind::DateTimeField(ast::DateTimeField::NoDateTime) } => {
                functions::call("floor", vec![self.bind(expr)?])
            }
            E::Substring { expr, substring_from, substring_for, .. } => {
                let parts = [Some(expr), substring_from.as_ref(), substring_for.as_ref()];
                let parts = parts.into_iter().flatten().map(|part| self.bind(part));
                functions::call("substr", parts.collect::<Answer<_>>()?)
            }
            E::Trim { expr, trim_where, trim_what, trim_characters } => {
                let name = match trim_where {
                    None | Some(ast::TrimWhereField::Both) => "trim",
                    Some(ast::TrimWhereField::Leading) => "ltrim",
                    Some(ast::TrimWhereField::Trailing) => "rtrim",
                };
                let mut arguments = vec![self.bind(expr)?];
                let characters = trim_characters.iter().flatten().chain(trim_what.as_deref());
                for characters in characters {
                    arguments.push(self.bind(characters)?);
                }
                functions::call(name, arguments)
            }
            E::Tuple(_) => refuse(format!(
                "'{}' compares several columns at once; compare each with AND, or join",
                shown(expr)
            )),
            E::AnyOp { .. } | E::AllOp { .. } => {
                refuse(format!("'{}' is not supported; use IN, or compare with max or min", shown(expr)))
            }
            E::Interval(_) | E::Extract { .. } | E::TypedString(_) | E::AtTimeZone { .. } => refuse(format!(
                "'{}' is about dates, and no table has any: 'started' is text as 2026-01-31T12:00:00Z, to be compared \
                 with text, or cut with substr",
                shown(expr)
            )),
            E::GroupingSets(_) | E::Cube(_) | E::Rollup(_) => refuse(
                "ROLLUP, CUBE and GROUPING SETS are not supported; write a query each, with UNION ALL".into(),
            ),
            other => refuse(format!("'{}' is not supported", shown(other))),
        }
    }

    fn column(&self, path: &[ast::Ident]) -> Answer<Value> {
        let found = match resolve(self.columns, path) {
            Ok(column) => column,
            Err(Unresolved::Ambiguous(message)) => return refuse(message),
            Err(Unresolved::Unknown(message)) => {
                if let [name] = path
                    && let Some((_, written)) =
                        self.aliases.iter().find(|(alias, _)| same(alias, &name.value))
                {
                    return Self { aliases: &[], ..*self }.bind(written);
                }
                return refuse(self.unknown(path, message));
            }
        };
        if self.groups.is_some() {
            return refuse(format!(
                "'{name}' is one of many in a group; add it to GROUP BY, or say which with an aggregate as max({name})",
                name = found.name
            ));
        }
        Ok(Value::column(&found.id, found.kind))
    }

    /// Why a name is unknown, when it isn't simply wrong.
    fn unknown(&self, path: &[ast::Ident], message: String) -> String {
        let name = path.iter().map(|part| part.value.as_str()).collect::<Vec<_>>().join(".");
        if self.planner.around(path) {
            return format!(
                "'{name}' belongs to the query around the subquery, which is not supported; write a join instead"
            );
        }
        match path {
            [one] if one.quote_style == Some('"') => {
                format!("{message}. Text stands in single quotes: '{name}'")
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
                    return refuse(format!("'{}' is {}, no number", shown(expr), value.kind.name()));
                }
                if op == UnaryOperator::Plus {
                    return Ok(value);
                }
                let zero = match value.kind {
                    // 0 - 0.0 would lose its sign.
                    Type::Real => return Ok(Value::new(value.expr * lit(-1.0), Type::Real)),
                    _ => Value::literal(AnyValue::Int64(0), Type::Integer),
                };
                functions::arithmetic(zero, '-', value)
            }
            other => refuse(format!("the operator {other} is not supported")),
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
                        return refuse(format!(
                            "'{}' can't be computed: '{}' is {}",
                            shown(whole),
                            shown(expr),
                            value.kind.name()
                        ));
                    }
                }
                functions::arithmetic(left_value, sign, right_value)
            }
            B::StringConcat => {
                let parts = [self.bind(left)?, self.bind(right)?];
                let [left, right] = parts.map(functions::text);
                Ok(Value::new(left?.expr + right?.expr, Type::Text))
            }
            B::DuckIntegerDivide => refuse("the operator // is not supported; use floor(a / b)".into()),
            other => refuse(format!("the operator {other} is not supported")),
        }
    }

    /// Two values to compare, of one type.
    fn pair(&self, left: &ast::Expr, right: &ast::Expr, whole: &ast::Expr) -> Answer<(Expr, Expr)> {
        let (left, right) = (self.bind(left)?, self.bind(right)?);
        let kind = match common(&[&left, &right], whole)? {
            // Polars doesn't compare nulls that have no type.
            Type::Null => Type::Flag,
            kind => kind,
        };
        Ok((left.to(kind), right.to(kind)))
    }

    fn like(&self, value: &ast::Expr, pattern: &ast::Expr, flags: &str) -> Answer<Expr> {
        let (text, pattern) = (self.bind(value)?, self.bind(pattern)?);
        if !matches!(text.kind, Type::Text | Type::Null) {
            return refuse(format!("LIKE is for text, and '{}' is {}", shown(value), text.kind.name()));
        }
        match pattern.constant() {
            Some(AnyValue::Null) => Ok(Value::null(Type::Flag).expr),
            Some(AnyValue::StringOwned(pattern)) => {
                Ok(text.to(Type::Text).str().contains(lit(regex(&pattern, flags)), true))
            }
            _ => refuse("LIKE takes a text in quotes as its pattern".into()),
        }
    }

    fn case(
        &self,
        operand: Option<&ast::Expr>,
        conditions: &[ast::CaseWhen],
        otherwise: Option<&ast::Expr>,
        whole: &ast::Expr,
    ) -> Answer<Value> {
        let mut branches = Vec::with_capacity(conditions.len());
        for ast::CaseWhen { condition, result } in conditions {
            let condition = match operand {
                None => self.condition(condition)?,
                Some(operand) => {
                    let (operand, wanted) = self.pair(operand, condition, whole)?;
                    operand.eq(wanted)
                }
            };
            branches.push((condition, self.bind(result)?));
        }
        let otherwise = otherwise.map_or(Ok(Value::null(Type::Null)), |expr| self.bind(expr))?;
        let results: Vec<&Value> = branches.iter().map(|(_, result)| result).chain([&otherwise]).collect();
        let kind = common(&results, whole)?;
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
            D::Int(None) | D::Integer(None) => {
                functions::to_integer(value, expr, strict, i32::MIN.into(), i32::MAX.into())
            }
            D::BigInt(None) => functions::to_integer(value, expr, strict, i64::MIN, i64::MAX),
            D::Double(ExactNumberInfo::None) | D::DoublePrecision => functions::to_real(value, strict),
            D::Varchar(None) | D::Text | D::String(None) => functions::text(value),
            D::Boolean | D::Bool => match value.kind {
                Type::Flag | Type::Null => Ok(Value::new(value.to(Type::Flag), Type::Flag)),
                Type::Integer => Ok(Value::new(value.expr.neq(lit(0)), Type::Flag)),
                other => refuse(format!("{} can't be cast to boolean; compare it instead", other.name())),
            },
            other => refuse(format!(
                "there is no type {other}; there are INTEGER, BIGINT, DOUBLE, VARCHAR and BOOLEAN"
            )),
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
            return refuse(format!("'{}' is not supported", shown(function)));
        };
        if !plain || !list.clauses.is_empty() {
            return refuse(format!(
                "'{}' is not supported: a function takes arguments, DISTINCT, FILTER and OVER alone",
                shown(function)
            ));
        }
        let distinct = matches!(list.duplicate_treatment, Some(ast::DuplicateTreatment::Distinct));
        let arguments = list.args.iter().map(|argument| match argument {
            ast::FunctionArg::Unnamed(ast::FunctionArgExpr::Expr(expr)) => Ok(Some(expr)),
            ast::FunctionArg::Unnamed(ast::FunctionArgExpr::Wildcard) if name == "count" => Ok(None),
            other => refuse(format!("'{other}' can't be an argument of {name}")),
        });
        // `*` is no argument.
        let arguments: Vec<&ast::Expr> =
            arguments.collect::<Answer<Vec<_>>>()?.into_iter().flatten().collect();
        if let Some(over) = over {
            let call = super::window::Call {
                name: &name,
                arguments: &arguments,
                distinct,
                filter: filter.as_deref(),
            };
            return super::window::bind(self, &call, over, function);
        }
        if Aggregate::is_name(&name) {
            return self.aggregate(&name, &arguments, distinct, filter.as_deref(), function);
        }
        if distinct || filter.is_some() {
            return refuse(format!("DISTINCT and FILTER are for aggregates, and {name} is none"));
        }
        if super::window::is_name(&name) {
            return refuse(format!("{name} needs OVER (ORDER BY …)"));
        }
        let arguments = arguments.into_iter().map(|expr| self.bind(expr)).collect::<Answer<Vec<_>>>()?;
        functions::call(&name, arguments)
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
            return refuse(match self.clause {
                "WHERE" => format!("'{}' can't be in WHERE; use HAVING", shown(written)),
                clause => format!(
                    "'{}' can't be in {clause}; compute it in a query of its own, with WITH",
                    shown(written)
                ),
            });
        };
        let inside = Self { clause: "an aggregate", ..self.rows() };
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
        // Polars' sum of integers wraps around; that of real numbers says when.
        let real = self.planner.fresh();
        let (sum, _) = aggregate.of(&argument_id, Type::Real, distinct)?;
        groups.aggregates.push(sum.alias(&real));
        Ok(functions::sum_within_integers(value, col(&*real)))
    }

    /// The aggregate that is called, and what it is of: null in the rows that FILTER leaves out.
    pub fn argument(
        &self,
        name: &str,
        arguments: &[&ast::Expr],
        filter: Option<&ast::Expr>,
    ) -> Answer<(Aggregate, Value)> {
        let values = arguments.iter().map(|expr| self.bind(expr)).collect::<Answer<Vec<_>>>()?;
        let values = values.into_iter().map(Value::for_computing).collect();
        let (aggregate, argument) = Aggregate::named(name, values)?;
        match filter {
            None => Ok((aggregate, argument)),
            Some(filter) => {
                let kind = argument.kind;
                let kept =
                    when(self.condition(filter)?).then(argument.expr).otherwise(Value::null(kind).expr);
                Ok((aggregate, Value::new(kept, kind)))
            }
        }
    }
}

/// The type that holds all of `values`.
fn common(values: &[&Value], whole: &ast::Expr) -> Answer<Type> {
    let mut kind = Type::Null;
    for value in values {
        match kind.common(value.kind) {
            Some(common) => kind = common,
            None => {
                let hint = match (kind, value.kind) {
                    (Type::Text, Type::Integer | Type::Real) | (Type::Integer | Type::Real, Type::Text) => {
                        "; text stands in quotes, a number does not"
                    }
                    _ => "",
                };
                return refuse(format!(
                    "'{}' mixes {} with {}{hint}",
                    shown(whole),
                    kind.name(),
                    value.kind.name()
                ));
            }
        }
    }
    Ok(kind)
}

/// Whether `value` is among `list`: unknown if it is not and some of them are unknown.
fn membership(value: &Value, list: Vec<Value>, whole: &ast::Expr) -> Answer<Expr> {
    if list.is_empty() {
        return Ok(lit(false));
    }
    let kind = common(&list.iter().chain([value]).collect::<Vec<_>>(), whole)?;
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
            Err(_) => refuse(format!("'{digits}' is no number")),
        },
        ast::Value::Number(digits, false) => match digits.parse() {
            Ok(integer) => Ok(Value::literal(AnyValue::Int64(integer), Type::Integer)),
            Err(_) => refuse(format!("'{digits}' is too large for an integer; write {digits}.0")),
        },
        ast::Value::SingleQuotedString(text) => {
            Ok(Value::literal(AnyValue::StringOwned(text.as_str().into()), Type::Text))
        }
        ast::Value::Boolean(flag) => Ok(Value::literal(AnyValue::Boolean(*flag), Type::Flag)),
        ast::Value::Null => Ok(Value::null(Type::Null)),
        other => refuse(format!("'{other}' is not supported")),
    }
}

/// LIKE's pattern as a regular expression.
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

/// What stands in brackets.
fn inner(expr: &ast::Expr) -> &ast::Expr {
    match expr {
        ast::Expr::Nested(expr) => inner(expr),
        expr => expr,
    }
}

/// Whether an expression has no operator that binds as little as a comparison, outside of brackets.
fn is_operand(expr: &ast::Expr) -> bool {
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

/// Whether an expression is of one row alone, without subqueries.
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

/// Whether an expression is an aggregate or a window function itself.
fn is_aggregate(expr: &ast::Expr) -> bool {
    matches!(expr, ast::Expr::Function(function)
        if function.over.is_some() || Aggregate::is_name(&function.name.to_string().to_lowercase()))
}

/// Whether an expression has an aggregate somewhere, outside of subqueries; one in a window function's OVER counts,
/// the window function itself doesn't.
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
