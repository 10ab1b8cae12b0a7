//! A fully connected layer, with or without ReLU, as one op.

use super::{slice, tensor, threads, with_values};
use crate::learning::kernels::{self, Into, Matrix, product};
use candle_core::{CpuStorage, CustomOp3, Layout, Result, Shape, Tensor};

/// `x wᵀ + b`, then ReLU if `relu`: `x` `[batch, in]`, `w` `[out, in]`, `b` `[out]`, result `[batch, out]`.
pub fn linear(x: &Tensor, w: &Tensor, b: &Tensor, relu: bool) -> Result<Tensor> {
    if x.device().is_cpu() {
        return x.contiguous()?.apply_op3(w, b, Linear { relu });
    }
    let y = x.matmul(&w.t()?)?.broadcast_add(b)?;
    if relu { y.relu() } else { Ok(y) }
}

struct Linear {
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
        let (batch, inputs) = x_layout.shape().dims2()?;
        let (outputs, _) = w_layout.shape().dims2()?;
        let mut y = kernels::scratch(batch * outputs);
        product(
            Matrix::plain(slice(x, x_layout)?, batch, inputs),
            Matrix::transposed(slice(w, w_layout)?, outputs, inputs),
            &mut y,
            Into::Overwrite,
            threads(),
        );
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
                let masked = with_values(y, |y| Ok(kernels::masked(grad, y)))?;
                gradients(x, w, &masked)
            } else {
                gradients(x, w, grad)
            }
        })
    }
}

/// Gradients of `x`, `w` and `b`, given that of `x wᵀ + b`.
fn gradients(
    x: &Tensor,
    w: &Tensor,
    grad: &[f32],
) -> Result<(Option<Tensor>, Option<Tensor>, Option<Tensor>)> {
    let ((batch, inputs), (outputs, _)) = (x.dims2()?, w.dims2()?);
    let grad_x = x.track_op().then(|| {
        let mut grad_x = kernels::scratch(batch * inputs);
        with_values(w, |w| {
            let grad = Matrix::plain(grad, batch, outputs);
            product(grad, Matrix::plain(w, outputs, inputs), &mut grad_x, Into::Overwrite, threads());
            Ok(())
        })?;
        tensor(grad_x, (batch, inputs))
    });
    let mut grad_w = kernels::scratch(outputs * inputs);
    with_values(x, |x| {
        let grad = Matrix::transposed(grad, batch, outputs);
        product(grad, Matrix::plain(x, batch, inputs), &mut grad_w, Into::Overwrite, threads());
        Ok(())
    })?;
    let grad_b = kernels::column_sums(grad, outputs);
    Ok((grad_x.transpose()?, Some(tensor(grad_w, (outputs, inputs))?), Some(tensor(grad_b, outputs)?)))
}
