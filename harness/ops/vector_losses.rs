//! The mean losses of several quantities whose columns lie side by side, as one op.

use super::{slice, tensor, with_values};
use candle_core::{CpuStorage, CustomOp1, Layout, Result, Shape, Tensor};
use harness_kernels as kernels;
use harness_spec::Loss;

/// The number of columns of a quantity, and its loss.
#[derive(Debug, Clone, Copy)]
pub struct Quantity {
    /// Number of columns.
    pub width: usize,
    /// Loss of each value's error.
    pub loss: Loss,
}

/// Returns the mean loss of each quantity over its columns and the batch, `[quantities]`. The `quantities` divide the
/// columns of `predicted` and `target`, both `[batch, width]`, from left to right.
///
/// # Errors
/// When the shapes do not match.
pub fn vector_losses(predicted: &Tensor, target: &Tensor, quantities: &[Quantity]) -> Result<Tensor> {
    if predicted.device().is_cpu() {
        let op = VectorLosses { target: target.contiguous()?, quantities: quantities.to_vec() };
        return predicted.contiguous()?.apply_op1(op);
    }
    let errors = (predicted - target)?;
    let mut first = 0;
    let means = quantities.iter().map(|quantity| {
        first += quantity.width;
        composed(quantity.loss, &errors.narrow(1, first - quantity.width, quantity.width)?)?.mean_all()
    });
    Tensor::stack(&means.collect::<Result<Vec<_>>>()?, 0)
}

/// Computes the loss of each error with candle's operations.
///
/// # Errors
/// When candle can't compute an operation.
pub fn composed(loss: Loss, errors: &Tensor) -> Result<Tensor> {
    match loss {
        Loss::Squared => errors.sqr(),
        Loss::Absolute => errors.abs(),
        Loss::Huber => {
            let size = errors.abs()?;
            let near = size.minimum(1.0)?;
            near.sqr()? + ((size - near)? * 2.0)?
        }
    }
}

/// The loss of one error. The Huber loss is twice the usual one, so that it equals the squared error up to an error of
/// 1.
fn value(loss: Loss, error: f64) -> f64 {
    match loss {
        Loss::Squared => error * error,
        Loss::Absolute => error.abs(),
        Loss::Huber if error.abs() <= 1.0 => error * error,
        Loss::Huber => 2.0 * error.abs() - 1.0,
    }
}

/// The derivative of [`value`]; 0 where it does not exist.
fn slope(loss: Loss, error: f32) -> f32 {
    match loss {
        Loss::Squared => 2.0 * error,
        Loss::Absolute if error == 0.0 => 0.0,
        Loss::Absolute => error.signum(),
        Loss::Huber => 2.0 * error.clamp(-1.0, 1.0),
    }
}

struct VectorLosses {
    target: Tensor,
    quantities: Vec<Quantity>,
}

impl VectorLosses {
    /// Returns the loss of each column.
    fn columns(&self) -> impl Iterator<Item = Loss> {
        self.quantities.iter().flat_map(|quantity| std::iter::repeat_n(quantity.loss, quantity.width))
    }
}

impl CustomOp1 for VectorLosses {
    fn name(&self) -> &'static str {
        "vector-losses"
    }

    fn cpu_fwd(&self, predicted: &CpuStorage, layout: &Layout) -> Result<(CpuStorage, Shape)> {
        let (batch, width) = layout.shape().dims2()?;
        let mut sums: Vec<(Loss, f64)> = self.columns().map(|loss| (loss, 0.0)).collect();
        let predicted = slice(predicted, layout)?;
        with_values(&self.target, |target| {
            for (predicted, target) in predicted.chunks_exact(width).zip(target.chunks_exact(width)) {
                for (((loss, sum), predicted), target) in sums.iter_mut().zip(predicted).zip(target) {
                    *sum += value(*loss, f64::from(predicted - target));
                }
            }
            Ok(())
        })?;
        let mut columns = sums.iter();
        let means = self.quantities.iter().map(|quantity| {
            let sum: f64 = columns.by_ref().take(quantity.width).map(|(_, sum)| sum).sum();
            (sum / (batch * quantity.width) as f64) as f32
        });
        Ok((CpuStorage::F32(means.collect()), self.quantities.len().into()))
    }

    fn bwd(&self, predicted: &Tensor, _losses: &Tensor, grad: &Tensor) -> Result<Option<Tensor>> {
        let (batch, width) = predicted.dims2()?;
        let mut factors = Vec::with_capacity(width);
        for (grad, quantity) in grad.to_vec1::<f32>()?.into_iter().zip(&self.quantities) {
            let factor = grad / (batch * quantity.width) as f32;
            factors.extend(std::iter::repeat_n((quantity.loss, factor), quantity.width));
        }
        let mut grads = kernels::scratch(batch * width);
        with_values(predicted, |predicted| {
            with_values(&self.target, |target| {
                let rows = predicted.chunks_exact(width).zip(target.chunks_exact(width));
                for (grads, (predicted, target)) in grads.chunks_exact_mut(width).zip(rows) {
                    for (((grad, predicted), target), (loss, factor)) in
                        grads.iter_mut().zip(predicted).zip(target).zip(&factors)
                    {
                        *grad = factor * slope(*loss, predicted - target);
                    }
                }
                Ok(())
            })
        })?;
        Ok(Some(tensor(grads, (batch, width))?))
    }
}
