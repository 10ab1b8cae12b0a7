//! A fully connected layer, with or without ReLU, as one op.

use super::{Arithmetic, slice, tensor, threads, with_values};
use candle_core::{CpuStorage, CustomOp3, Layout, Result, Shape, Tensor};
use harness_kernels as kernels;
use harness_kernels::product::{Accumulate, Matrix, product};

/// Returns `x wᵀ + b`, `[batch, out]`, with a ReLU if `relu`. `x` is `[batch, in]`, `w` is `[out, in]` and `b` is
/// `[out]`.
pub fn linear(x: &Tensor, w: &Tensor, b: &Tensor, relu: bool, arithmetic: Arithmetic) -> Result<Tensor> {
    #[cfg(feature = "cuda")]
    if x.device().is_cuda() {
        return crate::cuda::linear(x, w, b, relu, arithmetic);
    }
    x.contiguous()?.apply_op3(&w.contiguous()?, b, Linear { arithmetic, relu })
}

struct Linear {
    arithmetic: Arithmetic,
    relu: bool,
}

impl CustomOp3 for Linear {
    fn name(&self) -> &'static str {
        "linear"
    }

    fn cpu_fwd(
        &self,
        x: &CpuStorage,
        x_layout: &Layout,
        w: &CpuStorage,
        w_layout: &Layout,
        b: &CpuStorage,
        b_layout: &Layout,
    ) -> Result<(CpuStorage, Shape)> {
        let ((batch, inputs), (outputs, _)) = (x_layout.shape().dims2()?, w_layout.shape().dims2()?);
        let mut y = kernels::scratch(batch * outputs);
        let (x, w) = (slice(x, x_layout)?, slice(w, w_layout)?);
        let (x, w) = (Matrix::plain(x, batch, inputs), Matrix::transposed(w, outputs, inputs));
        product(x, w, &mut y, Accumulate::Overwrite, self.arithmetic, threads());
        kernels::add_bias(&mut y, slice(b, b_layout)?, self.relu);
        Ok((CpuStorage::F32(y), (batch, outputs).into()))
    }

    fn bwd(
        &self,
        x: &Tensor,
        w: &Tensor,
        _b: &Tensor,
        y: &Tensor,
        grad: &Tensor,
    ) -> Result<(Option<Tensor>, Option<Tensor>, Option<Tensor>)> {
        with_values(grad, |grad| {
            if self.relu {
                let mut masked = grad.to_vec();
                with_values(y, |y| {
                    kernels::mask(&mut masked, y);
                    Ok(())
                })?;
                self.gradients(x, w, &masked)
            } else {
                self.gradients(x, w, grad)
            }
        })
    }
}

impl Linear {
    /// Returns the gradients of `x`, `w` and `b`, given the gradient of `x wᵀ + b`.
    fn gradients(
        &self,
        x: &Tensor,
        w: &Tensor,
        grad: &[f32],
    ) -> Result<(Option<Tensor>, Option<Tensor>, Option<Tensor>)> {
        let ((batch, inputs), outputs) = (x.dims2()?, w.dim(0)?);
        let grad_x = x.track_op().then(|| {
            let mut grad_x = kernels::scratch(batch * inputs);
            with_values(w, |w| {
                let (grad, w) = (Matrix::plain(grad, batch, outputs), Matrix::plain(w, outputs, inputs));
                product(grad, w, &mut grad_x, Accumulate::Overwrite, self.arithmetic, threads());
                Ok(())
            })?;
            tensor(grad_x, (batch, inputs))
        });
        let mut grad_w = kernels::scratch(outputs * inputs);
        with_values(x, |x| {
            weight_gradient(grad, x, [outputs, inputs], &mut grad_w, self.arithmetic);
            Ok(())
        })?;
        let grad_b = tensor(kernels::column_sums(grad, outputs), outputs)?;
        Ok((grad_x.transpose()?, Some(tensor(grad_w, (outputs, inputs))?), Some(grad_b)))
    }
}

/// Computes the gradient of a weight `[outputs, inputs]` from the rows that it was multiplied with, `[n, inputs]`, and
/// the gradient of the products, `[n, outputs]`.
pub(super) fn weight_gradient(
    grad: &[f32],
    rows: &[f32],
    [outputs, inputs]: [usize; 2],
    wanted: &mut [f32],
    arithmetic: Arithmetic,
) {
    let count = rows.len() / inputs;
    let (grad, rows) = (Matrix::transposed(grad, count, outputs), Matrix::plain(rows, count, inputs));
    product(grad, rows, wanted, Accumulate::Overwrite, arithmetic, threads());
}
