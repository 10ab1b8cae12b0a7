//! Sampling from a posterior, and its divergence from the prior, as one op each.

use super::{slice, tensor, with_values};
use candle_core::{CpuStorage, CustomOp1, Layout, Result, Shape, Tensor};
use harness_kernels::{self as kernels, exp, simd};

/// Draws latent states: `mean + exp(log_variance / 2) * noise` (Kingma & Welling, 2014, equation 10).
///
/// `posterior` is `[batch, 2 * latent]`, the means followed by the log-variances. `noise` and the result are
/// `[batch, latent]`.
///
/// # Errors
/// When the noise has another shape.
pub fn sample(posterior: &Tensor, noise: &Tensor) -> Result<Tensor> {
    if posterior.device().is_cpu() {
        return posterior.contiguous()?.apply_op1(Sample { noise: noise.contiguous()? });
    }
    let (mean, log_variance) = halves(posterior)?;
    mean + ((log_variance * 0.5)?.exp()? * noise)?
}

/// Returns the Kullback-Leibler divergence from the standard normal distribution (Kingma & Welling, 2014, appendix B).
/// It is summed over the latent state and averaged over the batch. The result is a scalar, in nats. `posterior` is as
/// in [`sample`].
///
/// # Errors
/// When the tensor has no columns.
pub fn kl_divergence(posterior: &Tensor) -> Result<Tensor> {
    let batch = posterior.dim(0)? as f64;
    if posterior.device().is_cpu() {
        return posterior.contiguous()?.apply_op1(Divergence);
    }
    let (mean, log_variance) = halves(posterior)?;
    let terms = ((mean.sqr()? + log_variance.exp()?)? - (log_variance + 1.0)?)?;
    terms.sum_all()? * (0.5 / batch)
}

/// Splits a posterior into means and log-variances.
fn halves(posterior: &Tensor) -> Result<(Tensor, Tensor)> {
    let latent = posterior.dim(1)? / 2;
    Ok((posterior.narrow(1, 0, latent)?, posterior.narrow(1, latent, latent)?))
}

/// Draws latent states as [`sample`] does.
pub(super) fn draw(posterior: &[f32], noise: &[f32], drawn: &mut [f32], latent: usize) {
    let rows = posterior.chunks_exact(2 * latent).zip(noise.chunks_exact(latent));
    simd(
        #[inline(always)]
        || {
            for (drawn, (posterior, noise)) in drawn.chunks_exact_mut(latent).zip(rows) {
                let (mean, log_variance) = posterior.split_at(latent);
                for (((drawn, mean), log_variance), noise) in
                    drawn.iter_mut().zip(mean).zip(log_variance).zip(noise)
                {
                    *drawn = mean + exp(0.5 * log_variance) * noise;
                }
            }
        },
    );
}

/// Adds the gradients of the posterior to `of_posterior`. `grad` is the gradient of the latent states `drawn`.
pub(super) fn add_gradients([posterior, drawn, grad]: [&[f32]; 3], of_posterior: &mut [f32], latent: usize) {
    let rows =
        posterior.chunks_exact(2 * latent).zip(drawn.chunks_exact(latent)).zip(grad.chunks_exact(latent));
    simd(
        #[inline(always)]
        || {
            for (of_posterior, ((posterior, drawn), grad)) in
                of_posterior.chunks_exact_mut(2 * latent).zip(rows)
            {
                let (of_mean, of_log_variance) = of_posterior.split_at_mut(latent);
                let of_both = of_mean.iter_mut().zip(of_log_variance);
                // `drawn - mean` is `exp(log_variance / 2) * noise`.
                for ((((of_mean, of_log), drawn), mean), grad) in of_both.zip(drawn).zip(posterior).zip(grad)
                {
                    *of_mean += grad;
                    *of_log += 0.5 * grad * (drawn - mean);
                }
            }
        },
    );
}

struct Sample {
    noise: Tensor,
}

impl CustomOp1 for Sample {
    fn name(&self) -> &'static str {
        "sample"
    }

    fn cpu_fwd(&self, posterior: &CpuStorage, layout: &Layout) -> Result<(CpuStorage, Shape)> {
        let (batch, width) = layout.shape().dims2()?;
        let latent = width / 2;
        let mut drawn = kernels::scratch(batch * latent);
        let posterior = slice(posterior, layout)?;
        with_values(&self.noise, |noise| {
            draw(posterior, noise, &mut drawn, latent);
            Ok(())
        })?;
        Ok((CpuStorage::F32(drawn), (batch, latent).into()))
    }

    fn bwd(&self, posterior: &Tensor, drawn: &Tensor, grad: &Tensor) -> Result<Option<Tensor>> {
        let (batch, width) = posterior.dims2()?;
        let latent = width / 2;
        let mut grads = kernels::scratch(batch * width);
        with_values(posterior, |posterior| {
            with_values(drawn, |drawn| {
                with_values(grad, |grad| {
                    add_gradients([posterior, drawn, grad], &mut grads, latent);
                    Ok(())
                })
            })
        })?;
        Ok(Some(tensor(grads, (batch, width))?))
    }
}

struct Divergence;

impl CustomOp1 for Divergence {
    fn name(&self) -> &'static str {
        "divergence"
    }

    fn cpu_fwd(&self, posterior: &CpuStorage, layout: &Layout) -> Result<(CpuStorage, Shape)> {
        let (batch, width) = layout.shape().dims2()?;
        let mut terms = kernels::scratch(width / 2);
        let mut nats = 0.0;
        for row in slice(posterior, layout)?.chunks_exact(width) {
            let (mean, log_variance) = row.split_at(width / 2);
            simd(
                #[inline(always)]
                || {
                    for ((term, mean), log) in terms.iter_mut().zip(mean).zip(log_variance) {
                        *term = mean * mean + exp(*log) - log - 1.0;
                    }
                },
            );
            nats += f64::from(0.5 * kernels::sum(&terms));
        }
        Ok((CpuStorage::F32(vec![(nats / batch as f64) as f32]), ().into()))
    }

    fn bwd(&self, posterior: &Tensor, _divergence: &Tensor, grad: &Tensor) -> Result<Option<Tensor>> {
        let (batch, width) = posterior.dims2()?;
        let factor = grad.to_scalar::<f32>()? / batch as f32;
        let mut grads = kernels::scratch(batch * width);
        with_values(posterior, |posterior| {
            simd(
                #[inline(always)]
                || {
                    for (grads, posterior) in grads.chunks_exact_mut(width).zip(posterior.chunks_exact(width))
                    {
                        let (grad_mean, grad_log_variance) = grads.split_at_mut(width / 2);
                        let (mean, log_variance) = posterior.split_at(width / 2);
                        for ((of_mean, of_log), (mean, log)) in
                            grad_mean.iter_mut().zip(grad_log_variance).zip(mean.iter().zip(log_variance))
                        {
                            *of_mean = factor * mean;
                            *of_log = factor * 0.5 * (exp(*log) - 1.0);
                        }
                    }
                },
            );
            Ok(())
        })?;
        Ok(Some(tensor(grads, (batch, width))?))
    }
}
