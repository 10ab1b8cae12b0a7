//! The supported functions and aggregates, with the types of their arguments and results.

use super::scope::Type;
use super::value::{Value, common};
use super::{Answer, shown};
use harness_shared::nearest;
use polars::prelude::*;
use sqlparser::ast;

type RealFunction = fn(f64) -> f64;

/// Functions of one real number that return a real number.
const REAL: [(&str, RealFunction); 12] = [
    ("sqrt", f64::sqrt),
    ("exp", f64::exp),
    ("ln", f64::ln),
    ("log10", f64::log10),
    ("log2", f64::log2),
    ("sin", f64::sin),
    ("cos", f64::cos),
    ("degrees", f64::to_degrees),
    ("radians", f64::to_radians),
    ("floor", f64::floor),
    ("ceil", f64::ceil),
    ("trunc", f64::trunc),
];

/// The names of all other functions of one row.
const OTHER: &str = "abs round power pow mod atan2 isnan isinf isfinite greatest least coalesce nullif upper lower \
    length substr left right replace concat starts_with ends_with contains split_part";

/// The names of the aggregates.
const AGGREGATES: &str =
    "count count_if sum avg min max arg_min arg_max stddev variance median quantile_cont bool_and bool_or";

/// The functions that need OVER. Aggregates can be called with or without it.
pub const OVER_ORDER: [&str; 7] =
    ["row_number", "rank", "dense_rank", "lag", "lead", "first_value", "last_value"];

/// Functions of other databases, and what to write instead.
const ELSEWHERE: [(&str, &str); 14] = [
    ("log", "log10, or ln for the natural logarithm"),
    ("cbrt", "power(x, 1.0 / 3)"),
    ("tan asin acos atan", "sin, cos and atan2"),
    ("pi", "radians(180)"),
    ("sign", "CASE WHEN x > 0 THEN 1 WHEN x < 0 THEN -1 ELSE 0 END"),
    ("ceiling", "ceil"),
    ("ifnull", "coalesce"),
    ("char_length", "length"),
    ("substring", "substr(text, first, count)"),
    ("trim ltrim rtrim", "replace(text, ' ', '')"),
    ("mean", "avg"),
    ("min_by argmin", "arg_min"),
    ("max_by argmax", "arg_max"),
    ("stddev_samp stddev_pop var_samp var_pop", "stddev or variance, which are those of a sample"),
];

/// The functions that fail for some values.
pub const FALLIBLE: [&str; 2] = ["abs", "mod"];

/// Refuses a part of the query about dates.
pub fn no_dates<T>(part: &str) -> Answer<T> {
    refuse!(
        "'{part}' is about dates, and no table has any: 'started' is text such as 2026-01-31T12:00:00Z; compare it \
         with text, or use substr"
    )
}

/// Whether a list of words has this word.
fn has(words: &str, word: &str) -> bool {
    words.split(' ').any(|other| other == word)
}

/// Functions of dates in other databases.
const OF_DATES: &str = "date_trunc date_part date_diff datediff strftime strptime now age year month day hour \
    to_timestamp current_timestamp";

/// Calls the function `name`, which computes a value from values of one row. Where one of [`FALLIBLE`] fails, it is an
/// error if `strict`, and null otherwise.
pub fn call(name: &str, arguments: Vec<Value>, strict: bool) -> Answer<Value> {
    let arguments: Vec<Value> = arguments.into_iter().map(Value::for_computing).collect();
    if let Some((_, function)) = REAL.iter().find(|(known, _)| *known == name) {
        let value = one_number(name, arguments)?;
        let rounds = matches!(name, "floor" | "ceil" | "trunc");
        return match value.kind {
            Type::Integer if rounds => Ok(value),
            _ => Ok(Value::new(of_reals(value.to(Type::Real), *function), Type::Real)),
        };
    }
    let numbers = |values: &[Value]| values.iter().try_for_each(|value| number(name, value));
    match name {
        "abs" => {
            let value = one_number(name, arguments)?;
            if value.kind != Type::Integer {
                return Ok(Value::new(value.expr.abs(), value.kind));
            }
            let absolute = move |value: i64, _: i64| {
                let too_large =
                    || format!("abs({value}) is too large for 64 bits; make it real, such as with * 1.0");
                failed(value.checked_abs(), strict, too_large)
            };
            let zero = Value::literal(AnyValue::Int64(0), Type::Integer).expr;
            let expr = of_two::<Int64Type>(value.to(Type::Integer), zero, Type::Integer, false, absolute);
            Ok(Value::new(expr, Type::Integer))
        }
        "round" => round(arguments),
        "power" | "pow" | "atan2" => {
            let [a, b] = take(name, arguments)?;
            numbers(&[a.clone(), b.clone()])?;
            Ok(of_two_reals(a, b, if name == "atan2" { f64::atan2 } else { f64::powf }))
        }
        "mod" => {
            let [value, divisor] = take(name, arguments)?;
            numbers(&[value.clone(), divisor.clone()])?;
            arithmetic(value, '%', divisor, strict)
        }
        "isnan" | "isinf" | "isfinite" => {
            let value = one_number(name, arguments)?.to(Type::Real);
            let is = match name {
                "isnan" => value.is_nan(),
                "isinf" => value.is_infinite(),
                _ => value.is_finite(),
            };
            Ok(Value::new(is, Type::Flag))
        }
        "greatest" | "least" => {
            numbers(&arguments)?;
            extreme(name, arguments)
        }
        "coalesce" => {
            if arguments.is_empty() {
                return refuse!("coalesce takes several values");
            }
            let kind = one_type(name, &arguments)?;
            let values: Vec<Expr> = arguments.into_iter().map(|value| value.to(kind)).collect();
            Ok(Value::new(coalesce(&values), kind))
        }
        "nullif" => {
            let [value, null] = take(name, arguments)?;
            let compared = one_type(name, &[value.clone(), null.clone()])?;
            let equal = value.clone().to(compared).eq(null.to(compared));
            let kind = value.kind;
            Ok(Value::new(when(equal).then(Value::null(kind).expr).otherwise(value.expr), kind))
        }
        "concat" => {
            if arguments.is_empty() {
                return refuse!("concat takes several values");
            }
            let parts =
                arguments.into_iter().map(|value| Ok(text(value)?.expr)).collect::<Answer<Vec<_>>>()?;
            Ok(Value::new(concat_str(parts, "", true), Type::Text))
        }
        "upper" | "lower" | "length" | "substr" | "left" | "right" | "replace" | "starts_with"
        | "ends_with" | "contains" | "split_part" => of_text(name, arguments),
        _ => unknown(name),
    }
}

/// Refuses the name of a function of one row that does not exist, whatever its arguments are.
pub fn check_name(name: &str) -> Answer<()> {
    match REAL.iter().any(|(known, _)| *known == name) || has(OTHER, name) {
        true => Ok(()),
        false => unknown(name),
    }
}

/// Refuses a function that does not exist, and says what to write instead.
fn unknown<T>(name: &str) -> Answer<T> {
    if has(OF_DATES, name) {
        return no_dates(name);
    }
    if let Some((_, instead)) = ELSEWHERE.iter().find(|(names, _)| has(names, name)) {
        return refuse!("there is no function '{name}'; write {instead}");
    }
    let real = REAL.iter().map(|(name, _)| *name);
    let names: Vec<&str> =
        real.chain(OTHER.split(' ')).chain(AGGREGATES.split(' ')).chain(OVER_ORDER).collect();
    match nearest(name, &names) {
        Some(known) => refuse!("there is no function '{name}'; did you mean '{known}'?"),
        None => refuse!("there is no function '{name}'; there are {}", names.join(", ")),
    }
}

/// The arguments, which must be exactly `N`.
fn take<const N: usize>(name: &str, arguments: Vec<Value>) -> Answer<[Value; N]> {
    let found = arguments.len();
    match arguments.try_into() {
        Ok(arguments) => Ok(arguments),
        Err(_) => refuse!("{name} takes {N} value(s), not {found}"),
    }
}

fn number(name: &str, value: &Value) -> Answer<()> {
    if value.kind.is_number() {
        return Ok(());
    }
    refuse!("{name} takes a number, not {}", value.kind.name())
}

/// The only argument, which must be a number.
fn one_number(name: &str, arguments: Vec<Value>) -> Answer<Value> {
    let [value] = take(name, arguments)?;
    number(name, &value)?;
    match value.kind {
        Type::Null => Ok(Value::new(value.to(Type::Integer), Type::Integer)),
        _ => Ok(value),
    }
}

/// The common type of all values.
fn one_type(name: &str, values: &[Value]) -> Answer<Type> {
    match common(values) {
        Ok(kind) => Ok(kind),
        Err([one, other]) => refuse!("{name} mixes {} with {}", one.name(), other.name()),
    }
}

/// The field of a column of type `kind` that a function of columns returns.
pub fn field(kind: Type) -> impl Fn(&Schema, &[Field]) -> PolarsResult<Field> + Send + Sync + 'static {
    move |_, fields| Ok(Field::new(fields[0].name().clone(), kind.data_type()))
}

fn of_reals(value: Expr, function: impl Fn(f64) -> f64 + Copy + Send + Sync + 'static) -> Expr {
    let of_column = move |columns: &mut [Column]| Ok(columns[0].f64()?.apply_values(function).into_column());
    value.map_many(of_column, &[], field(Type::Real))
}

/// Applies a function to columns. If it fails for some values, Polars must not apply it to rows that an earlier
/// condition excludes. Polars moves functions of rows before conditions, but not those of groups.
fn mapped(
    first: Expr,
    rest: &[Expr],
    kind: Type,
    can_fail: bool,
    function: impl Fn(&mut [Column]) -> PolarsResult<Column> + Send + Sync + 'static,
) -> Expr {
    match can_fail {
        true => first.apply_many(function, rest, field(kind)),
        false => first.map_many(function, rest, field(kind)),
    }
}

/// Applies a function row by row to columns of the same type, any of which may be a constant.
fn of_rows<T: PolarsNumericType>(
    first: Expr,
    rest: &[Expr],
    kind: Type,
    can_fail: bool,
    function: impl Fn(&[Option<T::Native>]) -> PolarsResult<Option<T::Native>> + Send + Sync + 'static,
) -> Expr {
    mapped(first, rest, kind, can_fail, move |columns| {
        let columns: Vec<Series> =
            columns.iter().map(|column| column.as_materialized_series().rechunk()).collect();
        let columns = columns.iter().map(|column| column.unpack());
        let columns = columns.collect::<PolarsResult<Vec<&ChunkedArray<T>>>>()?;
        let length = columns.iter().map(|values| values.len()).find(|length| *length != 1).unwrap_or(1);
        let mut values = vec![None; columns.len()];
        let of_row = |row: usize| {
            for (value, column) in values.iter_mut().zip(&columns) {
                *value = column.get(if column.len() == 1 { 0 } else { row });
            }
            function(&values)
        };
        let results = (0..length).map(of_row).collect::<PolarsResult<Vec<Option<T::Native>>>>()?;
        Ok(ChunkedArray::<T>::from_slice_options(columns[0].name().clone(), &results).into_column())
    })
}

/// Applies a function to two columns of the same type in the rows in which neither is null.
fn of_two<T: PolarsNumericType>(
    left: Expr,
    right: Expr,
    kind: Type,
    can_fail: bool,
    function: impl Fn(T::Native, T::Native) -> PolarsResult<Option<T::Native>> + Send + Sync + 'static,
) -> Expr {
    of_rows::<T>(left, &[right], kind, can_fail, move |values| match values {
        [Some(left), Some(right)] => function(*left, *right),
        _ => Ok(None),
    })
}

fn of_two_reals(left: Value, right: Value, function: fn(f64, f64) -> f64) -> Value {
    let (left, right) = (left.to(Type::Real), right.to(Type::Real));
    let of_row = move |a, b| Ok(Some(function(a, b)));
    Value::new(of_two::<Float64Type>(left, right, Type::Real, false, of_row), Type::Real)
}

/// The result of an operation that fails for some values. Its failure is an error if `strict`, and null otherwise.
fn failed<T>(result: Option<T>, strict: bool, reason: impl Fn() -> String) -> PolarsResult<Option<T>> {
    match result {
        None if strict => Err(PolarsError::ComputeError(reason().into())),
        result => Ok(result),
    }
}

/// Computes `left sign right` for two numbers. `/` returns a real number. Integer overflow and a remainder by zero are
/// errors if `strict`, and null otherwise.
pub fn arithmetic(left: Value, sign: char, right: Value, strict: bool) -> Answer<Value> {
    let (left, right) = (left.for_computing(), right.for_computing());
    let kind = match left.kind.common(right.kind) {
        Some(Type::Null) => Type::Integer,
        Some(kind) if sign != '/' => kind,
        _ => Type::Real,
    };
    let (left, right) = (left.to(kind), right.to(kind));
    if kind == Type::Real {
        let expr = match sign {
            '+' => left + right,
            '-' => left - right,
            '*' => left * right,
            '/' => left / right,
            _ => of_two::<Float64Type>(left, right, kind, false, |a, b| Ok(Some(a % b))),
        };
        return Ok(Value::new(expr, kind));
    }
    let operation: fn(i64, i64) -> Option<i64> = match sign {
        '+' => i64::checked_add,
        '-' => i64::checked_sub,
        '*' => i64::checked_mul,
        _ => i64::checked_rem,
    };
    let checked = move |a: i64, b: i64| {
        failed(operation(a, b), strict, || {
            let problem = match (sign, b) {
                ('%', 0) => {
                    "has no value, because the divisor is 0; leave out such rows, or write nullif(…, 0)"
                }
                ('%', _) => "is not a 64-bit integer",
                _ => "is not a 64-bit integer; make one of them real, such as with * 1.0",
            };
            format!("{a} {sign} {b} {problem}")
        })
    };
    Ok(Value::new(of_two::<Int64Type>(left, right, kind, strict && sign == '%', checked), kind))
}

/// Returns a sum of integers, or an error if it overflows. `real` is the same sum, computed with real numbers.
pub fn sum_within_integers(sum: Value, real: Expr) -> Value {
    let checked =
        |columns: &mut [Column]| match columns[1].f64()?.iter().flatten().find(|sum| sum.abs() >= 9.2e18) {
            None => Ok(columns[0].clone()),
            Some(sum) => Err(PolarsError::ComputeError(
                format!(
                    "a sum of integers is {sum:e}, too large for 64 bits; make them real, such as with * 1.0"
                )
                .into(),
            )),
        };
    Value::new(sum.expr.map_many(checked, &[real], field(Type::Integer)), Type::Integer)
}

fn round(arguments: Vec<Value>) -> Answer<Value> {
    let decimals = match arguments.as_slice() {
        [_] => 0,
        [_, decimals] => match decimals.constant() {
            Some(AnyValue::Int64(decimals @ 0..=15)) => decimals as i32,
            _ => return refuse!("round takes a number, and a number of decimals from 0 to 15"),
        },
        _ => return refuse!("round takes a number, and a number of decimals"),
    };
    let value = arguments.into_iter().next().expect("there are one or two");
    number("round", &value)?;
    if value.kind == Type::Integer {
        return Ok(value);
    }
    // DuckDB rounds like this: it scales, and rounds halves away from zero.
    let scale = 10_f64.powi(decimals);
    let rounded = move |number: f64| {
        let scaled = (number * scale).round() / scale;
        if scaled.is_finite() { scaled } else { number }
    };
    Ok(Value::new(of_reals(value.to(Type::Real), rounded), Type::Real))
}

/// The greatest or least of several values. Nulls are ignored, and NaN is greater than any number.
fn extreme(name: &str, arguments: Vec<Value>) -> Answer<Value> {
    let kind = match one_type(name, &arguments)? {
        Type::Null => Type::Integer,
        kind => kind,
    };
    let mut values = arguments.into_iter().map(|value| value.to(kind));
    let Some(first) = values.next() else {
        return refuse!("{name} takes several values");
    };
    let rest: Vec<Expr> = values.collect();
    let is_greatest = name == "greatest";
    let expr = match kind {
        Type::Integer => best::<Int64Type>(first, &rest, kind, is_greatest, |a, b| a > b),
        _ => best::<Float64Type>(first, &rest, kind, is_greatest, |a, b| a > b || a.is_nan() && !b.is_nan()),
    };
    Ok(Value::new(expr, kind))
}

fn best<T: PolarsNumericType>(
    first: Expr,
    rest: &[Expr],
    kind: Type,
    is_greatest: bool,
    greater: fn(T::Native, T::Native) -> bool,
) -> Expr {
    let better = move |best, value| if greater(value, best) == is_greatest { value } else { best };
    of_rows::<T>(first, rest, kind, false, move |values| Ok(values.iter().flatten().copied().reduce(better)))
}

fn of_text(name: &str, arguments: Vec<Value>) -> Answer<Value> {
    let mut arguments = arguments.into_iter();
    let Some(value) = arguments.next() else {
        return refuse!("{name} takes a text");
    };
    if !matches!(value.kind, Type::Text | Type::Null) {
        return refuse!("{name} takes text, not {}", value.kind.name());
    }
    let value = value.to(Type::Text);
    let rest: Vec<Value> = arguments.collect();
    let constants: Vec<Option<AnyValue>> = rest.iter().map(|value| value.constant()).collect();
    let words: Vec<Option<&str>> =
        constants.iter().map(|value| value.as_ref().and_then(|value| value.get_str())).collect();
    let counts: Vec<Option<u64>> = constants
        .iter()
        .map(|value| match value {
            Some(AnyValue::Int64(count)) => u64::try_from(*count).ok(),
            _ => None,
        })
        .collect();
    let is_text = rest.iter().all(|value| matches!(value.kind, Type::Text | Type::Null));
    let text = || value.clone().str();
    let (expr, kind) = match (name, words.as_slice(), counts.as_slice()) {
        ("upper", [], _) => (text().to_uppercase(), Type::Text),
        ("lower", [], _) => (text().to_lowercase(), Type::Text),
        ("length", [], _) => (text().len_chars().cast(DataType::Int64), Type::Integer),
        ("left", _, [Some(count)]) => (text().slice(lit(0_i64), lit(*count)), Type::Text),
        ("right", _, [Some(count)]) => {
            (text().tail(lit(i64::try_from(*count).unwrap_or(i64::MAX))), Type::Text)
        }
        ("substr", _, [Some(start @ 1..)]) => {
            (text().slice(lit((*start - 1) as i64), lit(u64::MAX)), Type::Text)
        }
        ("substr", _, [Some(start @ 1..), Some(count)]) => {
            (text().slice(lit((*start - 1) as i64), lit(*count)), Type::Text)
        }
        ("replace", [Some(old), Some(new)], _) if !old.is_empty() => {
            (text().replace_all(lit(*old), lit(*new), true), Type::Text)
        }
        ("starts_with", [_], _) if is_text => {
            (text().starts_with(rest[0].clone().to(Type::Text)), Type::Flag)
        }
        ("ends_with", [_], _) if is_text => (text().ends_with(rest[0].clone().to(Type::Text)), Type::Flag),
        ("contains", [_], _) if is_text => {
            (text().contains_literal(rest[0].clone().to(Type::Text)), Type::Flag)
        }
        ("split_part", [Some(separator), _], [_, Some(part @ 1..)]) if !separator.is_empty() => {
            let (separator, part) = (separator.to_string(), *part as usize - 1);
            let split = move |text: &str| {
                Ok(AnyValue::StringOwned(text.split(&separator).nth(part).unwrap_or_default().into()))
            };
            (of_each_text(value.clone(), Type::Text, false, split), Type::Text)
        }
        _ => {
            let takes = match name {
                "left" | "right" => "a text and a number of characters",
                "substr" => "a text, a position from 1 on, and a number of characters",
                "replace" => "a text, the text to replace, and its replacement, both in quotes",
                "split_part" => "a text, the separator in quotes, and the part's number from 1 on",
                "starts_with" | "ends_with" | "contains" => "two texts",
                _ => "a text",
            };
            return refuse!("{name} takes {takes}");
        }
    };
    Ok(Value::new(expr, kind))
}

/// Applies a function to each text of a column.
fn of_each_text(
    value: Expr,
    kind: Type,
    can_fail: bool,
    function: impl Fn(&str) -> PolarsResult<AnyValue<'static>> + Send + Sync + 'static,
) -> Expr {
    mapped(value, &[], kind, can_fail, move |columns| {
        let texts = columns[0].str()?;
        let results = texts.iter().map(|text| text.map_or(Ok(AnyValue::Null), &function));
        let results = results.collect::<PolarsResult<Vec<_>>>()?;
        let name = texts.name().clone();
        Ok(Series::from_any_values_and_dtype(name, &results, &kind.data_type(), true)?.into_column())
    })
}

/// Converts a value to text. Real numbers and bytes are refused.
pub fn text(value: Value) -> Answer<Value> {
    match value.kind {
        Type::Text => Ok(value),
        Type::Integer | Type::Flag | Type::Null => {
            Ok(Value::new(value.expr.cast(DataType::String), Type::Text))
        }
        Type::Single | Type::Real => refuse!(
            "a real number can't be cast to text; cast it to an integer first: cast(round(x) as integer)"
        ),
        Type::Bytes => refuse!("bytes can't be cast to text"),
    }
}

/// The real number that a text stands for. Digits may have single underscores between them.
fn real(text: &str) -> Option<f64> {
    let text = text.trim();
    let is_digit = |byte: Option<&u8>| byte.is_some_and(u8::is_ascii_digit);
    let bytes = text.as_bytes();
    let is_between =
        |place: usize| place > 0 && is_digit(bytes.get(place - 1)) && is_digit(bytes.get(place + 1));
    if text.match_indices('_').any(|(place, _)| !is_between(place)) {
        return None;
    }
    text.replace('_', "").parse().ok()
}

/// The integer that is nearest to the number that a text stands for. Halves are rounded away from zero, as DuckDB does
/// with decimal numbers.
fn nearest_integer(text: &str) -> Option<i64> {
    let text = text.trim();
    let number = real(text).filter(|number| number.is_finite())?;
    let digits = text.replace('_', "");
    let (whole, fraction) = digits.split_once('.').unwrap_or((&digits, ""));
    if digits.contains(['e', 'E']) {
        let rounded = number.round();
        return (rounded.abs() < 2_f64.powi(53)).then_some(rounded as i64);
    }
    // Exact where a real number of 64 bits is not.
    let away = match (fraction.as_bytes().first(), whole.starts_with('-')) {
        (Some(b'5'..), false) => 1,
        (Some(b'5'..), true) => -1,
        _ => 0,
    };
    let whole = if matches!(whole, "" | "-" | "+") { 0 } else { whole.parse::<i64>().ok()? };
    whole.checked_add(away)
}

/// Whether the value of an expression is a whole number: it is that of `floor(x)`, `round(x)` or a similar function.
fn is_whole(written: &ast::Expr) -> bool {
    let ast::Expr::Function(function) = written else {
        return matches!(written, ast::Expr::Ceil { .. } | ast::Expr::Floor { .. });
    };
    let name = function.name.to_string().to_lowercase();
    let has_one = matches!(&function.args, ast::FunctionArguments::List(list) if list.args.len() == 1);
    has_one && ["round", "floor", "ceil", "trunc"].contains(&&*name)
}

/// Converts a value to an integer from `least` to `most`. A value that is no such integer is an error if `strict`, and
/// null otherwise.
pub fn to_integer(value: Value, written: &ast::Expr, strict: bool, least: i64, most: i64) -> Answer<Value> {
    let checked = move |integer: Option<i64>, from: &dyn std::fmt::Display| {
        let within = integer.filter(|integer| (least..=most).contains(integer));
        let reason =
            || format!("'{from}' is not an integer from {least} to {most}; TRY_CAST returns null instead");
        Ok(failed(within, strict, reason)?.map_or(AnyValue::Null, AnyValue::Int64))
    };
    let expr = match value.kind {
        Type::Null => return Ok(Value::null(Type::Integer)),
        Type::Flag => value.expr.cast(DataType::Int64),
        Type::Bytes | Type::Single => {
            return refuse!("{} can't be cast to an integer", value.kind.name());
        }
        Type::Text => {
            of_each_text(value.expr, Type::Integer, strict, move |text| checked(nearest_integer(text), &text))
        }
        Type::Real if !is_whole(written) => {
            return refuse!(
                "'{}' is a real number; choose how to round it: cast(round(…) as integer), or floor, ceil or trunc",
                shown(written)
            );
        }
        Type::Integer | Type::Real => {
            let kind = value.kind;
            let each = move |columns: &mut [Column]| {
                let series = columns[0].as_materialized_series().rechunk();
                let results = series.iter().map(|value| match value {
                    AnyValue::Int64(integer) => checked(Some(integer), &integer),
                    AnyValue::Float64(real) => {
                        // 2^63 is the smallest real number that is too large for i64.
                        let fits = (-2_f64.powi(63)..2_f64.powi(63)).contains(&real);
                        checked(fits.then_some(real as i64), &real)
                    }
                    _ => Ok(AnyValue::Null),
                });
                let results = results.collect::<PolarsResult<Vec<_>>>()?;
                Ok(Series::from_any_values_and_dtype(
                    series.name().clone(),
                    &results,
                    &DataType::Int64,
                    true,
                )?
                .into_column())
            };
            mapped(value.to(kind), &[], Type::Integer, strict, each)
        }
    };
    Ok(Value::new(expr, Type::Integer))
}

/// Converts a value to a real number. A text that is no number is an error if `strict`, and null otherwise.
pub fn to_real(value: Value, strict: bool) -> Answer<Value> {
    let expr = match value.kind {
        Type::Null => return Ok(Value::null(Type::Real)),
        Type::Bytes => return refuse!("bytes can't be cast to a real number"),
        Type::Flag => value.expr.cast(DataType::Float64),
        Type::Integer | Type::Single | Type::Real => value.to(Type::Real),
        Type::Text => of_each_text(value.expr, Type::Real, strict, move |text| {
            let reason = || format!("'{text}' is not a number; TRY_CAST returns null instead");
            Ok(failed(real(text), strict, reason)?.map_or(AnyValue::Null, AnyValue::Float64))
        }),
    };
    Ok(Value::new(expr, Type::Real))
}

/// The order of numbers in SQL: NaN is larger than any other.
fn order(a: &f64, b: &f64) -> std::cmp::Ordering {
    a.partial_cmp(b).unwrap_or_else(|| a.is_nan().cmp(&b.is_nan()))
}

/// A function of all values of a group. Null values are ignored.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Aggregate {
    /// Number of rows: `count(*)`.
    Rows,
    /// Number of values.
    Count,
    /// Sum of the values; null without values.
    Sum,
    /// Mean of the values.
    Mean,
    /// Smallest value.
    Min,
    /// Largest value. NaN is larger than any number.
    Max,
    /// Standard deviation of a sample: one degree of freedom is subtracted from the count.
    Deviation,
    /// Variance of a sample: one degree of freedom is subtracted from the count.
    Variance,
    /// Quantile at this probability, with linear interpolation.
    Quantile(f64),
    /// Whether all values are true.
    All,
    /// Whether a value is true.
    Any,
}

/// The value in the row in which another value, `by`, is smallest, or largest with `arg_max`: the first such row. Rows
/// in which one of the two is null are left out. Both are names of columns.
pub fn value_at(name: &str, value: &str, by: &str) -> Expr {
    let order =
        SortMultipleOptions::default().with_order_descending(name == "arg_max").with_maintain_order(true);
    let counts = col(value).is_not_null().and(col(by).is_not_null());
    col(value).filter(counts.clone()).sort_by([col(by).filter(counts)], order).first()
}

impl Aggregate {
    /// Whether an aggregate has this name, in lower case.
    pub fn is_name(name: &str) -> bool {
        has(AGGREGATES, name)
    }

    /// The aggregate of this name, and the value that it aggregates.
    pub fn named(name: &str, arguments: Vec<Value>) -> Answer<(Self, Value)> {
        let (mut argument, share) = match (name, arguments.as_slice()) {
            ("arg_min" | "arg_max", _) => return refuse!("{name} can't have OVER"),
            ("count", []) => {
                return Ok((Self::Rows, Value::literal(AnyValue::Boolean(true), Type::Flag)));
            }
            ("quantile_cont", [argument, share]) => (argument.clone(), share.constant()),
            ("quantile_cont", _) => (Value::null(Type::Null), None),
            _ => {
                let [argument] = take(name, arguments)?;
                (argument, None)
            }
        };
        let aggregate = match (name, share) {
            ("count", _) => Self::Count,
            ("sum" | "count_if", _) => Self::Sum,
            ("avg", _) => Self::Mean,
            ("min", _) => Self::Min,
            ("max", _) => Self::Max,
            ("stddev", _) => Self::Deviation,
            ("variance", _) => Self::Variance,
            ("median", _) => Self::Quantile(0.5),
            ("quantile_cont", Some(AnyValue::Float64(share))) if (0.0..=1.0).contains(&share) => {
                Self::Quantile(share)
            }
            ("quantile_cont", Some(AnyValue::Int64(share @ 0..=1))) => Self::Quantile(share as f64),
            ("quantile_cont", _) => return refuse!("{name} takes a column and a number from 0 to 1"),
            ("bool_and", _) => Self::All,
            ("bool_or", _) => Self::Any,
            (other, _) => return refuse!("the aggregate {other} is not supported"),
        };
        let is_of_flags = matches!(name, "count_if" | "bool_and" | "bool_or");
        match aggregate {
            Self::Rows | Self::Count | Self::Min | Self::Max => {}
            _ if !is_of_flags => number(name, &argument)?,
            _ if matches!(argument.kind, Type::Flag | Type::Null) => {}
            _ => return refuse!("{name} takes a condition, not {}", argument.kind.name()),
        }
        if name == "count_if" {
            // Like a sum, it is null if no condition is true or false.
            argument = Value::new(argument.to(Type::Flag).cast(DataType::Int64), Type::Integer);
        }
        Ok((aggregate, argument))
    }

    /// The aggregate of some numbers, as [`Aggregate::of`] computes it; `None` if it is null.
    pub fn of_values(self, values: Vec<f64>) -> Option<f64> {
        let count = values.len() as f64;
        let mean = || values.iter().sum::<f64>() / count;
        let variance = || {
            let mean = mean();
            let squares: f64 = values.iter().map(|value| (value - mean).powi(2)).sum();
            (count > 1.0).then(|| squares / (count - 1.0))
        };
        match self {
            // Rows that do not count are 0, and others 1.
            Self::Rows | Self::Count => Some(values.iter().sum()),
            _ if values.is_empty() => None,
            Self::Sum => Some(values.iter().sum()),
            Self::Mean => Some(mean()),
            Self::Deviation => variance().map(f64::sqrt),
            Self::Variance => variance(),
            Self::Min => values.iter().copied().min_by(order),
            Self::Max => values.iter().copied().max_by(order),
            Self::Quantile(share) => {
                let mut sorted = values;
                sorted.sort_by(order);
                let place = share * (sorted.len() - 1) as f64;
                let (low, high) = (sorted[place.floor() as usize], sorted[place.ceil() as usize]);
                Some(if low == high { low } else { low + (high - low) * place.fract() })
            }
            Self::All | Self::Any => None,
        }
    }

    /// The expression of the aggregate over the column `id` of type `kind`, and the type of its result. With
    /// `distinct`, equal values count once.
    pub fn of(self, id: &str, kind: Type, distinct: bool) -> Answer<(Expr, Type)> {
        let kind = match (self, kind) {
            (Self::All | Self::Any, Type::Null) => Type::Flag,
            (Self::Rows | Self::Count, kind) => kind,
            (_, Type::Null) => Type::Integer,
            (_, kind) => kind,
        };
        if kind == Type::Bytes && self != Self::Count && self != Self::Rows {
            return refuse!("bytes can only be counted");
        }
        let all = if self == Self::Rows { col(id) } else { col(id).cast(kind.data_type()) };
        let values = if distinct { all.clone().drop_nulls().unique_stable() } else { all.clone() };
        let none = || Value::null(kind).expr;
        let counted = || all.clone().count().gt(lit(0));
        Ok(match self {
            Self::Rows if distinct => {
                return refuse!("count(DISTINCT *) is not supported; count a column");
            }
            // FILTER sets the argument to null in the rows that do not count.
            Self::Rows | Self::Count => (values.count().cast(DataType::Int64), Type::Integer),
            Self::Sum => (when(counted()).then(values.sum()).otherwise(none()), kind),
            Self::Mean => (values.mean(), Type::Real),
            Self::Min => (values.min(), kind),
            // NaN is larger than any number, but Polars ignores it.
            Self::Max if kind == Type::Real => {
                let is_nan = values.clone().is_nan().any(true);
                (when(is_nan).then(lit(f64::NAN)).otherwise(values.max()), kind)
            }
            Self::Max => (values.max(), kind),
            Self::Deviation => (values.cast(DataType::Float64).std(1), Type::Real),
            Self::Variance => (values.cast(DataType::Float64).var(1), Type::Real),
            Self::Quantile(share) => {
                let values = values.cast(DataType::Float64);
                (values.quantile(lit(share), QuantileMethod::Linear), Type::Real)
            }
            Self::All => (when(counted()).then(values.all(true)).otherwise(none()), kind),
            Self::Any => (when(counted()).then(values.any(true)).otherwise(none()), kind),
        })
    }
}
