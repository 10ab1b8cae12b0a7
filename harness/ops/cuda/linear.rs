//! A fully connected layer, with or without ReLU.

use super::{Gpu, Matrix, column_sums, each, launch, not_on_cpu, slice, with_values};
use crate::Arithmetic;
use candle_core::cuda::cudarc::driver::CudaView;
use candle_core::{CudaStorage, CustomOp3, Layout, Result, Shape, Tensor};

/// The same as [`crate::linear`], on a GPU.
pub fn linear(x: &Tensor, w: &Tensor, b: &Tensor, relu: bool, arithmetic: Arithmetic) -> Result<Tensor> {
    x.contiguous()?.apply_op3(&w.contiguous()?, &b.contiguous()?, Linear { arithmetic, relu })
}

struct Linear {
    arithmetic: Arithmetic,
    relu: bool,
}

impl CustomOp3 for Linear {
    fn name(&self) -> &'static str {
        "linear"
    }

    not_on_cpu!(CpuStorage, CpuStorage, CpuStorage);

    fn cuda_fwd(
        &self,
        x: &CudaStorage,
        x_layout: &Layout,
        w: &CudaStorage,
        w_layout: &Layout,
        b: &CudaStorage,
        b_layout: &Layout,
    ) -> Result<(CudaStorage, Shape)> {
        let ((batch, inputs), (outputs, _)) = (x_layout.shape().dims2()?, w_layout.shape().dims2()?);
        let gpu = Gpu::with(x);
        let (x, w, b) = (slice(x, x_layout)?, slice(w, w_layout)?, slice(b, b_layout)?);
        let mut y = gpu.scratch(batch * outputs)?;
        let (x, w) = (Matrix::plain(&x, batch, inputs), Matrix::transposed(&w, outputs, inputs));
        gpu.product(x, w, &mut y, false, self.arithmetic)?;
        let len = batch * outputs;
        let (columns, relu) = (outputs as i32, i32::from(self.relu));
        launch!(gpu, VECTORS, "add_bias", each(len), &mut y, &b, &(len as i32), &columns, &relu);
        Ok(gpu.storage(y, (batch, outputs)))
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
            if !self.relu {
                return self.gradients(x, w, grad);
            }
            let gpu = Gpu::of(x)?;
            let mut masked = gpu.scratch(grad.len())?;
            with_values(y, |y| {
                let len = grad.len();
                launch!(gpu, VECTORS, "masked", each(len), grad, y, &mut masked, &1.0_f32, &(len as i32));
                Ok(())
            })?;
            self.gradients(x, w, &masked.as_view())
        })
    }
}

impl Linear {
    /// Returns the gradients of `x`, `w` and `b`, given the gradient of `x wᵀ + b`.
    fn gradients(
        &self,
        x: &Tensor,
        w: &Tensor,
        grad: &CudaView<f32>,
    ) -> Result<(Option<Tensor>, Option<Tensor>, Option<Tensor>)> {
        let (gpu, (batch, inputs), outputs) = (Gpu::of(x)?, x.dims2()?, w.dim(0)?);
        let grad_x = x.track_op().then(|| {
            let mut grad_x = gpu.scratch(batch * inputs)?;
            with_values(w, |w| {
                let (grad, w) = (Matrix::plain(grad, batch, outputs), Matrix::plain(w, outputs, inputs));
                gpu.product(grad, w, &mut grad_x, false, self.arithmetic)
            })?;
            Ok::<_, candle_core::Error>(gpu.tensor(grad_x, (batch, inputs)))
        });
        let mut grad_w = gpu.scratch(outputs * inputs)?;
        with_values(x, |x| {
            let (grad, x) = (Matrix::transposed(grad, batch, outputs), Matrix::plain(x, batch, inputs));
            gpu.product(grad, x, &mut grad_w, false, self.arithmetic)
        })?;
        let grad_b = gpu.tensor(column_sums(&gpu, grad, outputs)?, outputs);
        Ok((grad_x.transpose()?, Some(gpu.tensor(grad_w, (outputs, inputs))), Some(grad_b)))
    }
}
