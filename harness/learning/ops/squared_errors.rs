//! The mean squared errors of several quantities that lie side by side, as one op.

use super::{slice, tensor, with_values};
use crate::learning::kernels;
use candle_core::{CpuStorage, CustomOp1, Layout, Result, Shape, Tensor};

/// For each of the quantities, whose `widths` divide the columns of `predicted` and `target` `[batch, width]`, the
/// mean squared error over its columns and the batch; `[widths]`.
pub fn squared_errors(predicted: &Tensor, target: &Tensor, widths: &[usize]) -> Result<Tensor> {
    if predicted.device().is_cpu() {
        let op = SquaredErrors { target: target.contiguous()?, widths: widths.to_vec() };
        return predicted.contiguous()?.apply_op1(op);
    }
    let squares = (predicted - target)?.sqr()?;
    let mut first = 0;
    let means = widths.iter().map(|width| {
        first += width;
        squares.narrow(1, first - width, *width)?.mean_all()
    });
    Tensor::stack(&means.collect::<Result<Vec<_>>>()?, 0)
}

struct SquaredErrors {
    target: Tensor,
    widths: Vec<usize>,
}

impl CustomOp1 for SquaredErrors {
    fn name(&self) -> &'static str {
        "squared-errors"
    }

    fn cpu_fwd(&self, predicted: &CpuStorage, layout: &Layout) -> Result<(CpuStorage, Shape)> {
        let (batch, width) = layout.shape().dims2()?;
        let mut sums = vec![0.0; width];
        let predicted = slice(predicted, layout)?;
        with_values(&self.target, |target| {
            for (predicted, target) in predicted.chunks_exact(width).zip(target.chunks_exact(width)) {
                for ((sum, predicted), target) in sums.iter_mut().zip(predicted).zip(target) {
                    let error = f64::from(predicted - target);
                    *sum += error * error;
                }
            }
            Ok(())
        })?;
        let mut columns = sums.iter();
        let means = self.widths.iter().map(|width| {
            let sum: f64 = columns.by_ref().take(*width).sum();
            (sum / (batch * width) as f64) as f32
        });
        Ok((CpuStorage::F32(means.collect()), self.widths.len().into()))
    }

    fn bwd(&self, predicted: &Tensor, _errors: &Tensor, grad: &Tensor) -> Result<Option<Tensor>> {
        let (batch, width) = predicted.dims2()?;
        let mut factors = Vec::with_capacity(width);
        for (grad, width) in grad.to_vec1::<f32>()?.into_iter().zip(&self.widths) {
            factors.extend(std::iter::repeat_n(2.0 * grad / (batch * width) as f32, *width));
        }
        let mut grads = kernels::scratch(batch * width);
        with_values(predicted, |predicted| {
            with_values(&self.target, |target| {
                let rows = predicted.chunks_exact(width).zip(target.chunks_exact(width));
                for (grads, (predicted, target)) in grads.chunks_exact_mut(width).zip(rows) {
                    for (((grad, predicted), target), factor) in
                        grads.iter_mut().zip(predicted).zip(target).zip(&factors)
                    {
                        *grad = factor * (predicted - target);
                    }
                }
                Ok(())
            })
        })?;
        Ok(Some(tensor(grads, (batch, width))?))
    }
}
