//! A fully connected layer, with or without ReLU, as one op.

use super::{hand_over, is_trained, slice, tensor, threads, with_values};
use crate::learning::kernels;
use crate::learning::kernels::product::{Into, Matrix, product};
use crate::spec::Precision;
use candle_core::{CpuStorage, CustomOp2, Layout, Result, Shape, Tensor};

/// `x wᵀ + b`, then ReLU if `relu`: `x` `[batch, in]`, `w` `[out, in]` a variable or detached, `b` `[out]`, result
/// `[batch, out]`.
pub fn linear(x: &Tensor, w: &Tensor, b: &Tensor, relu: bool) -> Result<Tensor> {
    if x.device().is_cpu() {
        let trained = is_trained(w)?;
        return x.contiguous()?.apply_op2(b, Linear { w: w.clone(), trained, relu });
    }
    let y = x.matmul(&w.t()?)?.broadcast_add(b)?;
    if relu { y.relu() } else { Ok(y) }
}

struct Linear {
    w: Tensor,
    trained: bool,
    relu: bool,
}

impl CustomOp2 for Linear {
    fn name(&self) -> &'static str {
        "linear"
    }

    fn cpu_fwd(
        &self,
        x: &CpuStorage,
        x_layout: &Layout,
        b: &CpuStorage,
        b_layout: &Layout,
    ) -> Result<(CpuStorage, Shape)> {
        let (batch, inputs) = x_layout.shape().dims2()?;
        let outputs = self.w.dim(0)?;
        let mut y = kernels::scratch(batch * outputs);
        with_values(&self.w, |w| {
            let (x, w) =
                (Matrix::plain(slice(x, x_layout)?, batch, inputs), Matrix::transposed(w, outputs, inputs));
            product(x, w, &mut y, Into::Overwrite, Precision::F32, threads());
            Ok(())
        })?;
        kernels::add_bias(&mut y, slice(b, b_layout)?, self.relu);
        Ok((CpuStorage::F32(y), (batch, outputs).into()))
    }

    fn bwd(
        &self,
        x: &Tensor,
        _b: &Tensor,
        y: &Tensor,
        grad: &Tensor,
    ) -> Result<(Option<Tensor>, Option<Tensor>)> {
        with_values(grad, |grad| {
            if self.relu {
                let mut masked = grad.to_vec();
                with_values(y, |y| {
                    kernels::mask(&mut masked, y);
                    Ok(())
                })?;
                self.gradients(x, &masked)
            } else {
                self.gradients(x, grad)
            }
        })
    }
}

impl Linear {
    /// Gradients of `x` and `b`, given that of `x wᵀ + b`; hands over that of `w`.
    fn gradients(&self, x: &Tensor, grad: &[f32]) -> Result<(Option<Tensor>, Option<Tensor>)> {
        let ((batch, inputs), outputs) = (x.dims2()?, self.w.dim(0)?);
        let grad_x = x.track_op().then(|| {
            let mut grad_x = kernels::scratch(batch * inputs);
            with_values(&self.w, |w| {
                let (grad, w) = (Matrix::plain(grad, batch, outputs), Matrix::plain(w, outputs, inputs));
                product(grad, w, &mut grad_x, Into::Overwrite, Precision::F32, threads());
                Ok(())
            })?;
            tensor(grad_x, (batch, inputs))
        });
        if self.trained {
            let mut grad_w = kernels::scratch(outputs * inputs);
            with_values(x, |x| {
                let (grad, x) = (Matrix::transposed(grad, batch, outputs), Matrix::plain(x, batch, inputs));
                product(grad, x, &mut grad_w, Into::Overwrite, Precision::F32, threads());
                Ok(())
            })?;
            hand_over(&self.w, grad_w)?;
        }
        let grad_b = tensor(kernels::column_sums(grad, outputs), outputs)?;
        Ok((grad_x.transpose()?, Some(grad_b)))
    }
}
