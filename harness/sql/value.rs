//! Values of expressions: Polars expressions with a type.

use super::Answer;
use super::scope::Type;
use polars::prelude::*;

/// A Polars expression and the type of its values.
#[derive(Clone)]
pub struct Value {
    /// The expression.
    pub expr: Expr,
    /// The type of its values.
    pub kind: Type,
}

impl Value {
    /// The values of `expr`, which must be of type `kind`.
    pub fn new(expr: Expr, kind: Type) -> Self {
        Self { expr, kind }
    }

    /// A constant of type `kind`.
    pub fn literal(value: AnyValue, kind: Type) -> Self {
        Self::new(lit(Scalar::new(kind.data_type(), value.into_static())), kind)
    }

    /// A null of type `kind`.
    pub fn null(kind: Type) -> Self {
        Self::literal(AnyValue::Null, kind)
    }

    /// The values of the frame's column `id`.
    pub fn column(id: &str, kind: Type) -> Self {
        Self::new(col(id), kind)
    }

    /// The value of a constant; `None` if the expression is not a constant.
    pub fn constant(&self) -> Option<AnyValue<'static>> {
        match &self.expr {
            Expr::Literal(LiteralValue::Scalar(scalar)) => Some(scalar.value().clone()),
            _ => None,
        }
    }

    /// The expression, converted to a type that [`Type::common`] returned for its own.
    pub fn to(self, kind: Type) -> Expr {
        if self.kind == kind { self.expr } else { self.expr.cast(kind.data_type()) }
    }

    /// The value to compute with: real numbers of 32 bits are converted to 64 bits.
    pub fn for_computing(self) -> Self {
        match self.kind {
            Type::Single => Self::new(self.to(Type::Real), Type::Real),
            _ => self,
        }
    }

    /// Evaluates an expression without columns to a constant. Polars would treat it as a column of one row.
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
    df!("" => [true]).expect("a frame with one column is valid").lazy()
}

/// The common type of all values, or two types that have none.
pub fn common<'a>(values: impl IntoIterator<Item = &'a Value>) -> Result<Type, [Type; 2]> {
    let mut values = values.into_iter();
    values.try_fold(Type::Null, |kind, value| kind.common(value.kind).ok_or([kind, value.kind]))
}
