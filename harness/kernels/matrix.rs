//! Row-major matrices, as the operands and the destination of a product.

/// Whether a matrix is read as it is stored, or as its transpose.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Order {
    Plain,
    Transposed,
}

/// A row-major matrix operand, stored as `rows` x `columns`. `order` says whether it is transposed.
#[derive(Clone, Copy)]
pub struct Matrix<'a> {
    pub(super) values: &'a [f32],
    rows: usize,
    columns: usize,
    order: Order,
}

impl<'a> Matrix<'a> {
    /// Returns a view of the matrix as it is stored.
    pub fn plain(values: &'a [f32], rows: usize, columns: usize) -> Self {
        assert_eq!(values.len(), rows * columns, "a {rows} x {columns} matrix");
        Self { values, rows, columns, order: Order::Plain }
    }

    /// Returns a view of the transpose of the matrix stored as `rows` x `columns`, without a copy.
    pub fn transposed(values: &'a [f32], rows: usize, columns: usize) -> Self {
        Self { order: Order::Transposed, ..Self::plain(values, rows, columns) }
    }

    /// Returns the same view of other values of the same shape.
    pub(super) fn with_values<'b>(&self, values: &'b [f32]) -> Matrix<'b> {
        assert_eq!(values.len(), self.values.len(), "values of another matrix");
        Matrix { values, rows: self.rows, columns: self.columns, order: self.order }
    }

    /// Returns the number of rows and columns of the view.
    pub(super) fn shape(&self) -> (usize, usize) {
        match self.order {
            Order::Plain => (self.rows, self.columns),
            Order::Transposed => (self.columns, self.rows),
        }
    }

    /// Whether the values of the view's rows are adjacent in memory.
    #[cfg(target_arch = "x86_64")]
    pub(super) fn is_plain(&self) -> bool {
        self.order == Order::Plain
    }

    /// Returns the column stride and the row stride of the view.
    pub(super) fn strides(&self) -> (isize, isize) {
        match self.order {
            Order::Plain => (1, self.columns as isize),
            Order::Transposed => (self.columns as isize, 1),
        }
    }
}

/// Whether a product replaces the values of its destination or is added to them.
#[derive(Clone, Copy, PartialEq, Eq)]
pub enum Accumulate {
    /// Replaces the values.
    Overwrite,
    /// Adds to the values.
    Add,
}
