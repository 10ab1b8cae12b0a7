//! Layer normalization.

use super::{Gpu, blocks, column_sums, launch, not_on_cpu, slice, with_values};
use candle_core::cuda::cudarc::driver::CudaSlice;
use candle_core::{CudaStorage, CustomOp3, Layout, Result, Shape, Tensor, bail};
use std::sync::OnceLock;

/// Returns the rows of `x` `[batch, width]`, each normalized to mean 0 and variance 1, multiplied by `weight` and added
/// to `bias`. `epsilon` is added to the variance.
pub fn norm(x: &Tensor, weight: &Tensor, bias: &Tensor, epsilon: f32) -> Result<Tensor> {
    x.contiguous()?.apply_op3(weight, bias, Norm { epsilon, statistics: OnceLock::new() })
}

struct Norm {
    epsilon: f32,
    /// Mean and inverse of the standard deviation of each row, kept for the backward pass.
    statistics: OnceLock<CudaSlice<f32>>,
}

impl CustomOp3 for Norm {
    fn name(&self) -> &'static str {
        "norm"
    }

    not_on_cpu!(CpuStorage, CpuStorage, CpuStorage);

    fn cuda_fwd(
        &self,
        x: &CudaStorage,
        x_layout: &Layout,
        weight: &CudaStorage,
        weight_layout: &Layout,
        bias: &CudaStorage,
        bias_layout: &Layout,
    ) -> Result<(CudaStorage, Shape)> {
        let (gpu, (batch, width)) = (Gpu::with(x), x_layout.shape().dims2()?);
        let (x, weight, bias) =
            (slice(x, x_layout)?, slice(weight, weight_layout)?, slice(bias, bias_layout)?);
        let (mut y, mut statistics) = (gpu.scratch(batch * width)?, gpu.scratch(2 * batch)?);
        let (config, width_) = (blocks(batch, 256), width as i32);
        launch!(
            gpu,
            NORM,
            "layer_norm",
            config,
            &x,
            &weight,
            &bias,
            &mut y,
            &mut statistics,
            &width_,
            &self.epsilon
        );
        self.statistics.get_or_init(|| statistics);
        Ok(gpu.storage(y, (batch, width)))
    }

    fn bwd(
        &self,
        x: &Tensor,
        weight: &Tensor,
        _bias: &Tensor,
        _y: &Tensor,
        grad: &Tensor,
    ) -> Result<(Option<Tensor>, Option<Tensor>, Option<Tensor>)> {
        let (gpu, (batch, width)) = (Gpu::of(x)?, x.dims2()?);
        let Some(statistics) = self.statistics.get() else {
            bail!("the norm has no statistics to go back from")
        };
        let (mut of_x, mut product) = (gpu.scratch(batch * width)?, gpu.scratch(batch * width)?);
        let of_bias = with_values(grad, |grad| {
            with_values(x, |x| {
                with_values(weight, |weight| {
                    let (config, width) = (blocks(batch, 256), width as i32);
                    launch!(
                        gpu,
                        NORM,
                        "layer_norm_backward",
                        config,
                        x,
                        weight,
                        statistics,
                        grad,
                        &mut of_x,
                        &mut product,
                        &width
                    );
                    Ok(())
                })
            })?;
            column_sums(&gpu, grad, width)
        })?;
        let of_weight = column_sums(&gpu, &product.as_view(), width)?;
        Ok((
            Some(gpu.tensor(of_x, (batch, width))),
            Some(gpu.tensor(of_weight, width)),
            Some(gpu.tensor(of_bias, width)),
        ))
    }
}
