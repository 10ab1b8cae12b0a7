//! The mean losses of several quantities whose columns lie side by side, as one op.

use super::{Quantity, slice, tensor, with_values};
use candle_core::{CpuStorage, CustomOp1, Layout, Result, Shape, Tensor};
use harness_kernels as kernels;
use harness_spec::Loss;

/// Returns the mean loss of each quantity over its columns and the rows of each part of the batch, `[quantities,
/// parts]`. The `quantities` divide the columns of `predicted` and `target`, both `[batch, width]`, from left to right.
/// The `parts` divide the rows equally, from the first to the last.
pub fn vector_losses(
    predicted: &Tensor,
    target: &Tensor,
    quantities: &[Quantity],
    parts: usize,
) -> Result<Tensor> {
    if parts == 0 || !predicted.dim(0)?.is_multiple_of(parts) {
        candle_core::bail!("{} rows can't be divided into {parts} equal parts", predicted.dim(0)?);
    }
    #[cfg(feature = "cuda")]
    if predicted.device().is_cuda() {
        return crate::cuda::vector_losses(predicted, target, quantities, parts);
    }
    let op = VectorLosses { target: target.contiguous()?, quantities: quantities.to_vec(), parts };
    predicted.contiguous()?.apply_op1(op)
}

/// Computes the loss of each error with candle's operations.
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
    /// Number of parts of the batch that have losses of their own.
    parts: usize,
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
        let (rows, predicted) = (batch / self.parts, slice(predicted, layout)?);
        let mut means = vec![0.0; self.quantities.len() * self.parts];
        with_values(&self.target, |target| {
            let parts = predicted.chunks_exact(rows * width).zip(target.chunks_exact(rows * width));
            for (part, (predicted, target)) in parts.enumerate() {
                let mut sums: Vec<(Loss, f64)> = self.columns().map(|loss| (loss, 0.0)).collect();
                for (predicted, target) in predicted.chunks_exact(width).zip(target.chunks_exact(width)) {
                    for (((loss, sum), predicted), target) in sums.iter_mut().zip(predicted).zip(target) {
                        *sum += value(*loss, f64::from(predicted - target));
                    }
                }
                let mut columns = sums.iter();
                for (index, quantity) in self.quantities.iter().enumerate() {
                    let sum: f64 = columns.by_ref().take(quantity.width).map(|(_, sum)| sum).sum();
                    means[index * self.parts + part] = (sum / (rows * quantity.width) as f64) as f32;
                }
            }
            Ok(())
        })?;
        Ok((CpuStorage::F32(means), (self.quantities.len(), self.parts).into()))
    }

    fn bwd(&self, predicted: &Tensor, _losses: &Tensor, grad: &Tensor) -> Result<Option<Tensor>> {
        let (batch, width) = predicted.dims2()?;
        let (rows, grad) = (batch / self.parts, grad.to_vec2::<f32>()?);
        let factors_of = |part: usize| {
            let of = |(grad, quantity): (&Vec<f32>, &Quantity)| {
                let factor = grad[part] / (rows * quantity.width) as f32;
                std::iter::repeat_n((quantity.loss, factor), quantity.width)
            };
            grad.iter().zip(&self.quantities).flat_map(of).collect::<Vec<_>>()
        };
        let factors: Vec<_> = (0..self.parts).map(factors_of).collect();
        let mut grads = kernels::scratch(batch * width);
        with_values(predicted, |predicted| {
            with_values(&self.target, |target| {
                let given = predicted.chunks_exact(width).zip(target.chunks_exact(width));
                for (row, (grads, (predicted, target))) in
                    grads.chunks_exact_mut(width).zip(given).enumerate()
                {
                    for (((grad, predicted), target), (loss, factor)) in
                        grads.iter_mut().zip(predicted).zip(target).zip(&factors[row / rows])
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
