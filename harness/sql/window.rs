//! Window functions: `f(…) over (partition by … order by …)`.

use super::expression::{Binder, Call, Needed, Windows};
use super::functions::{Aggregate, OVER_ORDER, field, sum_within_integers};
use super::order::{Sorting, direction};
use super::scope::{Type, same};
use super::value::Value;
use super::{Answer, shown};
use polars::prelude::*;
use sqlparser::ast::{self, WindowFrameBound, WindowFrameUnits};
use std::cell::RefCell;

/// The maximum number of values that all frames of a partition have together.
const MOST_WORK: usize = 200_000_000;
const NO_VALUE_OF_ROWS: &str =
    "the first or last value of a frame with a number of rows is not supported; use lag or lead";

/// The columns that compute a window function. They are added to a frame in this order: inputs, place, steps.
pub struct Window {
    /// Arguments, and the expressions of PARTITION BY and ORDER BY.
    inputs: Vec<Expr>,
    /// The ids of the columns of PARTITION BY.
    partition: Vec<String>,
    /// The ids of the columns of ORDER BY, and their options.
    order: Vec<(String, (bool, bool))>,
    /// The id of a column with a row's position in the order.
    place: String,
    /// Each step may use the columns of the steps before it.
    steps: Vec<Expr>,
}

impl Window {
    fn new(binder: &Binder, spec: &ast::WindowSpec) -> Answer<Self> {
        let mut window = Self {
            inputs: Vec::new(),
            partition: Vec::new(),
            order: Vec::new(),
            place: binder.planner.fresh(),
            steps: Vec::new(),
        };
        for expr in &spec.partition_by {
            let id = window.input(binder, binder.bind(expr)?);
            window.partition.push(id);
        }
        if window.partition.is_empty() {
            let all = window.input(binder, Value::literal(AnyValue::Boolean(true), Type::Flag));
            window.partition.push(all);
        }
        for by in &spec.order_by {
            let options = direction(by)?;
            let id = window.input(binder, binder.bind(&by.expr)?);
            window.order.push((id, options));
        }
        Ok(window)
    }

    fn input(&mut self, binder: &Binder, value: Value) -> String {
        let id = binder.planner.fresh();
        self.inputs.push(value.expr.alias(&id));
        id
    }

    fn step(&mut self, binder: &Binder, expr: Expr) -> Expr {
        let id = binder.planner.fresh();
        self.steps.push(expr.alias(&id));
        col(&*id)
    }

    /// The columns in which peers are equal: rows of a partition with the same position in the order.
    fn peers(&self) -> Vec<Expr> {
        let order = self.order.iter().map(|(id, _)| id);
        self.partition.iter().chain(order).map(|id| col(&**id)).collect()
    }

    fn over_partition(&self, expr: Expr) -> PolarsResult<Expr> {
        expr.over(self.partition.iter().map(|id| col(&**id)).collect::<Vec<_>>())
    }

    /// `expr` over the ordered partition.
    fn ordered(&self, expr: Expr) -> PolarsResult<Expr> {
        self.over(expr, self.partition.iter().map(|id| col(&**id)).collect())
    }

    /// The value of `expr` in the last of a row's peers.
    fn last_of_peers(&self, expr: Expr) -> PolarsResult<Expr> {
        self.over(expr.last(), self.peers())
    }

    fn over(&self, expr: Expr, partition: Vec<Expr>) -> PolarsResult<Expr> {
        let order = (vec![col(&*self.place)], SortOptions::default());
        expr.over_with_options(Some(partition), Some(order), WindowMapping::GroupsToRows)
    }

    /// Adds the columns to a frame.
    pub fn apply(&self, frame: LazyFrame) -> LazyFrame {
        let frame = frame.with_columns(&self.inputs);
        let frame = if self.order.is_empty() { frame } else { self.placed(frame) };
        self.steps.iter().fold(frame, |frame, step| frame.with_columns([step.clone()]))
    }

    /// Adds the column `place`: each row's position in the order, counted from 0. Peers have different positions.
    fn placed(&self, frame: LazyFrame) -> LazyFrame {
        let before = format!("{}before", self.place);
        let mut sorting = Sorting::default();
        self.order.iter().for_each(|(id, options)| sorting.add(col(&**id), *options));
        let sorted = sorting.of(frame.with_row_index(&*before, None));
        sorted.with_row_index(&*self.place, None).sort([before], SortMultipleOptions::default())
    }
}

/// The rows of the partition that a function is computed over.
#[derive(Clone, Copy, PartialEq)]
enum Frame {
    /// The whole partition.
    All,
    /// From the partition's first row to this row.
    ToRow,
    /// From the partition's first row to the last of this row's peers, which is the standard's default with ORDER BY.
    ToPeers,
    /// From a row to another, counted from this row: -2 is the second row before it. `None` is the partition's end.
    Rows { first: Option<i64>, last: Option<i64> },
}

impl Frame {
    fn of(spec: &ast::WindowSpec) -> Answer<Self> {
        let Some(frame) = &spec.window_frame else {
            return Ok(if spec.order_by.is_empty() { Self::All } else { Self::ToPeers });
        };
        let end = frame.end_bound.as_ref().unwrap_or(&WindowFrameBound::CurrentRow);
        match (&frame.units, &frame.start_bound, end) {
            (
                WindowFrameUnits::Rows | WindowFrameUnits::Range,
                WindowFrameBound::Preceding(None),
                WindowFrameBound::Following(None),
            ) => Ok(Self::All),
            (WindowFrameUnits::Rows, WindowFrameBound::Preceding(None), WindowFrameBound::CurrentRow)
                if !spec.order_by.is_empty() =>
            {
                Ok(Self::ToRow)
            }
            (WindowFrameUnits::Range, WindowFrameBound::Preceding(None), WindowFrameBound::CurrentRow)
                if !spec.order_by.is_empty() =>
            {
                Ok(Self::ToPeers)
            }
            (WindowFrameUnits::Rows, start, end) if !spec.order_by.is_empty() => {
                let (first, last) = (offset(start)?, offset(end)?);
                match (start, end) {
                    (WindowFrameBound::Following(None), _) | (_, WindowFrameBound::Preceding(None)) => {}
                    _ if first.zip(last).is_some_and(|(first, last)| first > last) => {}
                    _ => return Ok(Self::Rows { first, last }),
                }
                refuse!("the frame 'ROWS BETWEEN {start} AND {end}' ends before it begins")
            }
            (units, start, end) => refuse!(
                "the frame '{units} BETWEEN {start} AND {end}' is not supported; use ORDER BY with ROWS, or RANGE \
                 BETWEEN UNBOUNDED PRECEDING AND CURRENT ROW, or leave both out for the whole partition",
            ),
        }
    }
}

/// The bound of a frame of rows, counted from the current row; `None` for an end of the partition.
fn offset(bound: &WindowFrameBound) -> Answer<Option<i64>> {
    let (rows, sign) = match bound {
        WindowFrameBound::CurrentRow => return Ok(Some(0)),
        WindowFrameBound::Preceding(None) | WindowFrameBound::Following(None) => return Ok(None),
        WindowFrameBound::Preceding(Some(rows)) => (rows, -1),
        WindowFrameBound::Following(Some(rows)) => (rows, 1),
    };
    match rows.to_string().parse::<u32>() {
        Ok(rows) => Ok(Some(sign * i64::from(rows))),
        Err(_) => refuse!("a frame takes a whole number of rows, not '{}'", shown(rows)),
    }
}

/// The window of the clause WINDOW that has this name.
fn named<'a>(binder: &Binder<'a>, name: &ast::Ident) -> Answer<&'a ast::WindowSpec> {
    let found = binder.named_windows.iter().find(|window| same(&window.0.value, &name.value));
    match found.map(|window| &window.1) {
        Some(ast::NamedWindowExpr::WindowSpec(spec)) => Ok(spec),
        Some(ast::NamedWindowExpr::NamedWindow(other)) => named(binder, other),
        None => refuse!("there is no window '{name}'; define it with WINDOW {name} AS (…)"),
    }
}

impl Windows for RefCell<Vec<Window>> {
    fn add(&self, binder: &Binder, call: &Call, over: &ast::WindowType) -> Answer<Value> {
        let (window, value) = bound(binder, call, over)?;
        self.borrow_mut().push(window);
        Ok(value)
    }
}

/// Binds a call with OVER: the columns that compute it, and its value.
fn bound(binder: &Binder, call: &Call, over: &ast::WindowType) -> Answer<(Window, Value)> {
    let spec = match over {
        ast::WindowType::WindowSpec(spec) => spec,
        ast::WindowType::NamedWindow(name) => named(binder, name)?,
    };
    if let Some(name) = &spec.window_name {
        return refuse!("a window can't add to the window {name}; write OVER {name}, or all of its parts");
    }
    if call.distinct {
        return refuse!("DISTINCT is not supported with OVER");
    }
    let binder = Binder {
        windows: None,
        clause: "a window function",
        aliases: &[],
        needed: Needed::Always,
        ..*binder
    };
    let mut window = Window::new(&binder, spec)?;
    let frame = Frame::of(spec)?;
    let value = if Aggregate::is_name(call.name) {
        aggregate(&binder, &mut window, call, frame)?
    } else if OVER_ORDER.contains(&call.name) {
        if window.order.is_empty() {
            return refuse!("{} needs an order: OVER (ORDER BY …)", call.name);
        }
        if call.filter.is_some() {
            return refuse!("FILTER is only for aggregates, and {} is not one", call.name);
        }
        if spec.window_frame.is_some() && !matches!(call.name, "first_value" | "last_value") {
            return refuse!("{} takes no frame; leave ROWS or RANGE out", call.name);
        }
        let values = call.arguments.iter().map(|expr| Ok(binder.bind(expr)?.for_computing()));
        of_rows(&binder, &mut window, call.name, values.collect::<Answer<_>>()?, frame)?
    } else {
        return refuse!("{} can't have OVER; only aggregates and {} can", call.name, OVER_ORDER.join(", "));
    };
    let expr = window.step(&binder, value.expr);
    Ok((window, Value::new(expr, value.kind)))
}

/// Binds an aggregate over each row's frame.
fn aggregate(binder: &Binder, window: &mut Window, call: &Call, frame: Frame) -> Answer<Value> {
    let (aggregate, argument) = binder.argument(call.name, call.arguments, call.filter)?;
    let value = over_frame(binder, window, aggregate, argument.clone(), call.name, frame)?;
    if aggregate != Aggregate::Sum || value.kind != Type::Integer {
        return Ok(value);
    }
    let real = Value::new(argument.to(Type::Real), Type::Real);
    let real = over_frame(binder, window, aggregate, real, call.name, frame)?;
    let (sum, real) = (window.step(binder, value.expr), window.step(binder, real.expr));
    Ok(sum_within_integers(Value::new(sum, value.kind), real))
}

/// An aggregate of `argument` over each row's frame.
fn over_frame(
    binder: &Binder,
    window: &mut Window,
    aggregate: Aggregate,
    argument: Value,
    name: &str,
    frame: Frame,
) -> Answer<Value> {
    let kind = argument.kind;
    let id = window.input(binder, argument);
    if frame == Frame::All {
        let (expr, kind) = aggregate.of(&id, kind, false)?;
        return Ok(Value::new(window.over_partition(expr)?, kind));
    }
    let (expr, kind) = match (frame, running(aggregate, &id, kind)) {
        (Frame::Rows { first, last }, _) => moving(aggregate, &id, kind, name, first, last)?,
        (_, Some(running)) => running,
        (_, None) => moving(aggregate, &id, kind, name, None, Some(0))?,
    };
    let expr = window.step(binder, window.ordered(expr)?);
    let expr = if frame == Frame::ToPeers { window.last_of_peers(expr)? } else { expr };
    Ok(Value::new(expr, kind))
}

/// The expression of an aggregate over the rows around each row, and the type of its result. Without `first`, the rows
/// begin with the partition's first, and without `last` they end with its last.
fn moving(
    aggregate: Aggregate,
    id: &str,
    kind: Type,
    name: &str,
    first: Option<i64>,
    last: Option<i64>,
) -> Answer<(Expr, Type)> {
    let is_count = matches!(aggregate, Aggregate::Rows | Aggregate::Count);
    let values = if is_count { col(id).is_not_null() } else { col(id) };
    let result = match aggregate {
        Aggregate::Sum | Aggregate::Min | Aggregate::Max if kind == Type::Integer => Type::Integer,
        _ if is_count => Type::Integer,
        Aggregate::All | Aggregate::Any => {
            return refuse!("a moving {name} is not supported; count the rows with count_if");
        }
        _ if kind.is_number() => Type::Real,
        _ => return refuse!("a moving {name} of {} is not supported", kind.name()),
    };
    let name = name.to_owned();
    let of_partition = move |columns: &mut [Column]| {
        let values = columns[0].f64()?.rechunk();
        let rows = values.len();
        let place = |row: usize, offset: i64| usize::try_from(row as i64 + offset).unwrap_or(0).min(rows);
        let from = |row| first.map_or(0, |first| place(row, first));
        let upto = |row| last.map_or(rows, |last| place(row, last + 1));
        let work: usize = (0..rows).map(|row| upto(row).saturating_sub(from(row))).sum();
        if work > MOST_WORK {
            let reason =
                format!("a moving {name} over {rows} rows takes too long; use PARTITION BY, or fewer rows");
            return Err(PolarsError::ComputeError(reason.into()));
        }
        let all: Vec<Option<f64>> = values.iter().collect();
        let of_row = |row: usize| {
            let within = &all[from(row).min(upto(row))..upto(row)];
            aggregate.of_values(within.iter().copied().flatten().collect())
        };
        let results: Vec<Option<f64>> = (0..rows).map(of_row).collect();
        let is_exact = |value: &f64| value.abs() < 2_f64.powi(53);
        if result == Type::Integer && !results.iter().flatten().all(is_exact) {
            let reason = format!("a moving {name} has more than 53 bits; make it real, such as with * 1.0");
            return Err(PolarsError::ComputeError(reason.into()));
        }
        let results = Float64Chunked::from_slice_options(columns[0].name().clone(), &results);
        results.into_column().cast(&result.data_type())
    };
    let values = values.cast(DataType::Float64);
    Ok((values.apply_many(of_partition, &[], field(result)), result))
}

/// Binds one of [`NAMES`]: a function of a row's position, or of another row's value.
fn of_rows(
    binder: &Binder,
    window: &mut Window,
    name: &str,
    values: Vec<Value>,
    frame: Frame,
) -> Answer<Value> {
    let number = window.ordered(col(&*window.place).cum_count(false))?.cast(DataType::Int64);
    let number = window.step(binder, number);
    match (name, values.as_slice()) {
        ("row_number", []) => Ok(Value::new(number, Type::Integer)),
        ("rank", []) => Ok(Value::new(number.min().over(window.peers())?, Type::Integer)),
        ("dense_rank", []) => {
            let is_first = number.clone().eq(number.min().over(window.peers())?).cast(DataType::Int64);
            let is_first = window.step(binder, is_first);
            Ok(Value::new(window.ordered(is_first.cum_sum(false))?, Type::Integer))
        }
        ("lag" | "lead", [value]) => neighbor(binder, window, name, number, value, 1, None),
        ("lag" | "lead", [value, distance] | [value, distance, _]) => match distance.constant() {
            Some(AnyValue::Int64(distance @ 0..=1_000_000_000)) => {
                neighbor(binder, window, name, number, value, distance, values.get(2))
            }
            _ => refuse!("{name} takes a column, and a number of rows"),
        },
        ("first_value", [_]) if matches!(frame, Frame::Rows { first: Some(_), .. }) => {
            refuse!("{NO_VALUE_OF_ROWS}")
        }
        ("first_value", [value]) => {
            let id = window.input(binder, value.clone());
            Ok(Value::new(window.ordered(col(&*id).first())?, value.kind))
        }
        ("last_value", [value]) => {
            let last = col(&*window.input(binder, value.clone()));
            let expr = match frame {
                Frame::All => window.ordered(last.last())?,
                Frame::ToRow => last,
                Frame::ToPeers => window.last_of_peers(last)?,
                Frame::Rows { .. } => return refuse!("{NO_VALUE_OF_ROWS}"),
            };
            Ok(Value::new(expr, value.kind))
        }
        _ => refuse!("{name} does not take {} value(s)", values.len()),
    }
}

/// Binds `lag` or `lead`: the value of the row `distance` rows before or after. Where there is no such row, the value
/// is `otherwise` or null.
fn neighbor(
    binder: &Binder,
    window: &mut Window,
    name: &str,
    number: Expr,
    value: &Value,
    distance: i64,
    otherwise: Option<&Value>,
) -> Answer<Value> {
    let kind = otherwise.map_or(Some(value.kind), |otherwise| value.kind.common(otherwise.kind));
    let Some(kind) = kind else {
        return refuse!("{name} mixes {} with another type", value.kind.name());
    };
    let id = window.input(binder, Value::new(value.clone().to(kind), kind));
    let is_lag = name == "lag";
    let shift = if is_lag { distance } else { -distance };
    let shifted = window.step(binder, window.ordered(col(&*id).shift(lit(shift)))?);
    let Some(otherwise) = otherwise else {
        return Ok(Value::new(shifted, kind));
    };
    let otherwise = col(&*window.input(binder, Value::new(otherwise.clone().to(kind), kind)));
    let is_outside = if is_lag {
        number.lt_eq(lit(distance))
    } else {
        number.gt(window.over_partition(len())?.cast(DataType::Int64) - lit(distance))
    };
    Ok(Value::new(when(is_outside).then(otherwise).otherwise(shifted), kind))
}

/// The expression of an aggregate from a partition's first row to each row, and the type of its result. Returns `None`
/// for aggregates that Polars can't compute like this.
fn running(aggregate: Aggregate, id: &str, kind: Type) -> Option<(Expr, Type)> {
    let column = col(id);
    let count = column.clone().is_not_null().cast(DataType::Int64).cum_sum(false);
    let some = |expr: Expr| when(count.clone().gt(lit(0))).then(expr).otherwise(lit(NULL));
    let latest = |expr: Expr| expr.fill_null_with_strategy(FillNullStrategy::Forward(None));
    let zero = match kind {
        Type::Real => lit(0.0),
        _ => lit(0_i64),
    };
    let sum = column.clone().fill_null(zero).cum_sum(false);
    Some(match (aggregate, kind) {
        (Aggregate::Rows | Aggregate::Count, _) => (count.clone(), Type::Integer),
        (Aggregate::Sum, Type::Integer | Type::Real) => (some(sum), kind),
        (Aggregate::Mean, Type::Integer | Type::Real) => {
            let sum = column.cast(DataType::Float64).fill_null(lit(0.0)).cum_sum(false);
            (some(sum / count.clone().cast(DataType::Float64)), Type::Real)
        }
        (Aggregate::Min, Type::Integer) => (latest(column.cum_min(false)), kind),
        (Aggregate::Max, Type::Integer) => (latest(column.cum_max(false)), kind),
        (Aggregate::Min | Aggregate::Max, Type::Real) => {
            // NaN is larger than any number.
            let numbers = when(column.clone().is_nan()).then(lit(NULL)).otherwise(column.clone());
            let nan_before =
                column.is_nan().fill_null(lit(false)).cast(DataType::Int64).cum_sum(false).gt(lit(0));
            let nan = when(nan_before).then(lit(f64::NAN));
            if aggregate == Aggregate::Max {
                (nan.otherwise(latest(numbers.cum_max(false))), kind)
            } else {
                (coalesce(&[latest(numbers.cum_min(false)), nan.otherwise(lit(NULL))]), kind)
            }
        }
        _ => return None,
    })
}
