//! Sampling from a posterior, and its divergence from a prior.

use super::{Gpu, blocks, each, launch, not_on_cpu, slice, with_values};
use candle_core::cuda::cudarc::driver::{CudaView, DevicePtr};
use candle_core::{CudaStorage, CustomOp1, CustomOp2, Layout, Result, Shape, Tensor, bail};

/// Number of threads in a block that sums all values.
const SUM_BLOCK: usize = 1024;
/// Number of threads that take a row.
const WARP: usize = 32;

/// The same as [`crate::sample`], on a GPU.
pub fn sample(posterior: &Tensor, noise: &Tensor) -> Result<Tensor> {
    posterior.contiguous()?.apply_op1(Sample { noise: noise.clone() })
}

/// The same as [`crate::kl_divergence`], on a GPU.
pub fn kl_divergence(posterior: &Tensor) -> Result<Tensor> {
    posterior.contiguous()?.apply_op1(Divergence { free: 0.0, representation: 1.0 })
}

/// The same as [`crate::balanced_divergence`], on a GPU.
pub fn balanced_divergence(
    posterior: &Tensor,
    prior: &Tensor,
    free: f64,
    representation: f64,
) -> Result<Tensor> {
    let op = Divergence { free: free as f32, representation: representation as f32 };
    posterior.contiguous()?.apply_op2(&prior.contiguous()?, op)
}

struct Sample {
    noise: Tensor,
}

impl CustomOp1 for Sample {
    fn name(&self) -> &'static str {
        "sample"
    }

    not_on_cpu!(CpuStorage);

    fn cuda_fwd(&self, posterior: &CudaStorage, layout: &Layout) -> Result<(CudaStorage, Shape)> {
        let (batch, width) = layout.shape().dims2()?;
        let (gpu, latent) = (Gpu::with(posterior), width / 2);
        let (posterior, len) = (slice(posterior, layout)?, batch * latent);
        let mut drawn = gpu.scratch(len)?;
        with_values(&self.noise, |noise| {
            if noise.len() != len {
                bail!("{} values of noise were given for {len} latent states", noise.len());
            }
            let sizes = (len as i32, latent as i32);
            launch!(gpu, POSTERIOR, "draw", each(len), &posterior, noise, &mut drawn, &sizes.0, &sizes.1);
            Ok(())
        })?;
        Ok(gpu.storage(drawn, (batch, latent)))
    }

    fn bwd(&self, posterior: &Tensor, drawn: &Tensor, grad: &Tensor) -> Result<Option<Tensor>> {
        let (gpu, (batch, latent)) = (Gpu::of(posterior)?, drawn.dims2()?);
        let mut of_posterior = gpu.scratch(batch * 2 * latent)?;
        with_values(posterior, |posterior| {
            with_values(drawn, |drawn| {
                with_values(grad, |grad| {
                    let len = batch * latent;
                    launch!(
                        gpu,
                        POSTERIOR,
                        "draw_gradients",
                        each(len),
                        posterior,
                        drawn,
                        grad,
                        &mut of_posterior,
                        &(len as i32),
                        &(latent as i32)
                    );
                    Ok(())
                })
            })
        })?;
        Ok(Some(gpu.tensor(of_posterior, posterior.shape())))
    }
}

/// The divergence from the standard normal distribution if there is one argument, and that from a prior if there are
/// two.
struct Divergence {
    free: f32,
    representation: f32,
}

impl Divergence {
    /// Returns the divergence, averaged over the rows. The distributions are `[rows, width]`.
    fn forward(
        &self,
        gpu: &Gpu,
        posterior: &CudaView<f32>,
        prior: Option<&CudaView<f32>>,
        (rows, width): (usize, usize),
    ) -> Result<(CudaStorage, Shape)> {
        let (mut nats, mut loss) = (gpu.scratch(rows)?, gpu.scratch(1)?);
        let (config, address) = (each(rows * WARP), address(gpu, prior));
        let (rows, latent) = (rows as i32, (width / 2) as i32);
        let factor = if prior.is_some() { 1.0 + self.representation } else { 1.0 };
        launch!(
            gpu,
            POSTERIOR,
            "divergences",
            config,
            posterior,
            &address,
            &mut nats,
            &rows,
            &latent,
            &self.free
        );
        launch!(gpu, POSTERIOR, "scaled_mean", blocks(1, SUM_BLOCK), &nats, &mut loss, &rows, &factor);
        Ok(gpu.storage(loss, ()))
    }

    /// Returns the gradients of the posterior and of the prior, if there is one.
    fn backward(
        &self,
        posterior: &Tensor,
        prior: Option<&CudaView<f32>>,
        grad: &Tensor,
    ) -> Result<[Tensor; 2]> {
        let (gpu, (rows, width)) = (Gpu::of(posterior)?, posterior.dims2()?);
        let mut of_posterior = gpu.scratch(rows * width)?;
        let mut of_prior = gpu.scratch(prior.map_or(1, |_| rows * width))?;
        with_values(posterior, |posterior| {
            with_values(grad, |grad| {
                launch!(
                    gpu,
                    POSTERIOR,
                    "divergence_gradients",
                    each(rows * WARP),
                    posterior,
                    &address(&gpu, prior),
                    grad,
                    &mut of_posterior,
                    &mut of_prior,
                    &(rows as i32),
                    &((width / 2) as i32),
                    &self.free,
                    &self.representation
                );
                Ok(())
            })
        })?;
        let len = of_prior.len();
        Ok([gpu.tensor(of_posterior, (rows, width)), gpu.tensor(of_prior, len)])
    }
}

/// Returns the address of values, or zero.
fn address(gpu: &Gpu, values: Option<&CudaView<f32>>) -> u64 {
    values.map_or(0, |values| values.device_ptr(&gpu.stream()).0)
}

impl CustomOp1 for Divergence {
    fn name(&self) -> &'static str {
        "divergence"
    }

    not_on_cpu!(CpuStorage);

    fn cuda_fwd(&self, posterior: &CudaStorage, layout: &Layout) -> Result<(CudaStorage, Shape)> {
        self.forward(&Gpu::with(posterior), &slice(posterior, layout)?, None, layout.shape().dims2()?)
    }

    fn bwd(&self, posterior: &Tensor, _divergence: &Tensor, grad: &Tensor) -> Result<Option<Tensor>> {
        let [of_posterior, _] = self.backward(posterior, None, grad)?;
        Ok(Some(of_posterior))
    }
}

impl CustomOp2 for Divergence {
    fn name(&self) -> &'static str {
        "balanced divergence"
    }

    not_on_cpu!(CpuStorage, CpuStorage);

    fn cuda_fwd(
        &self,
        posterior: &CudaStorage,
        layout: &Layout,
        prior: &CudaStorage,
        prior_layout: &Layout,
    ) -> Result<(CudaStorage, Shape)> {
        let (gpu, prior) = (Gpu::with(posterior), slice(prior, prior_layout)?);
        self.forward(&gpu, &slice(posterior, layout)?, Some(&prior), layout.shape().dims2()?)
    }

    fn bwd(
        &self,
        posterior: &Tensor,
        prior: &Tensor,
        _loss: &Tensor,
        grad: &Tensor,
    ) -> Result<(Option<Tensor>, Option<Tensor>)> {
        let [of_posterior, of_prior] =
            with_values(prior, |values| self.backward(posterior, Some(values), grad))?;
        Ok((Some(of_posterior), Some(of_prior.reshape(prior.shape())?)))
    }
}
