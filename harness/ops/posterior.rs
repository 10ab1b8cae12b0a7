//! Sampling from a posterior, and its divergence from a prior, as one op each.

use super::{slice, tensor, with_values};
use candle_core::{CpuStorage, CustomOp1, CustomOp2, Layout, Result, Shape, Tensor, bail};
use harness_kernels::{self as kernels, exp, simd};

/// Draws latent states: `mean + exp(log_variance / 2) * noise` (Kingma & Welling, 2014, equation 10).
///
/// `posterior` is `[batch, 2 * latent]`, the means followed by the log-variances. `noise` and the result are
/// `[batch, latent]`.
pub fn sample(posterior: &Tensor, noise: &Tensor) -> Result<Tensor> {
    #[cfg(feature = "cuda")]
    if posterior.device().is_cuda() {
        return crate::cuda::sample(posterior, noise);
    }
    posterior.contiguous()?.apply_op1(Sample { noise: noise.contiguous()? })
}

/// Returns the Kullback-Leibler divergence from the standard normal distribution (Kingma & Welling, 2014, appendix B).
/// It is summed over the latent state and averaged over the batch. The result is a scalar, in nats. `posterior` is as
/// in [`sample`].
pub fn kl_divergence(posterior: &Tensor) -> Result<Tensor> {
    #[cfg(feature = "cuda")]
    if posterior.device().is_cuda() {
        return crate::cuda::kl_divergence(posterior);
    }
    posterior.contiguous()?.apply_op1(Divergence)
}

/// Returns the Kullback-Leibler divergence of each dimension from a prior, or from the standard normal distribution,
/// `[batch, latent]`, in nats. Both are as in [`sample`].
pub fn divergences(posterior: &Tensor, prior: Option<&Tensor>) -> Result<Tensor> {
    let (mean, log_variance) = halves(posterior)?;
    let twice = match prior {
        None => ((mean.sqr()? + log_variance.exp()?)? - (log_variance + 1.0)?)?,
        Some(prior) => {
            let (prior_mean, log_prior) = halves(prior)?;
            let ratio = ((log_variance.exp()? + (mean - prior_mean)?.sqr()?)? / log_prior.exp()?)?;
            (((log_prior - log_variance)? + ratio)? - 1.0)?
        }
    };
    twice * 0.5
}

/// Returns the divergence of a posterior from a prior as a loss of both, averaged over the batch (Hafner et al.,
/// "Mastering diverse control tasks through world models", 2025). The result is a scalar, in nats. Both are as in
/// [`sample`].
///
/// The prior learns from the divergence, and the posterior from the same divergence with the weight `representation`.
/// Rows with a divergence below `free` nats count as `free`, and neither learns from them.
pub fn balanced_divergence(
    posterior: &Tensor,
    prior: &Tensor,
    free: f64,
    representation: f64,
) -> Result<Tensor> {
    if posterior.dims() != prior.dims() {
        bail!("the shapes of posterior and prior are {:?} and {:?}", posterior.dims(), prior.dims());
    }
    #[cfg(feature = "cuda")]
    if posterior.device().is_cuda() {
        return crate::cuda::balanced_divergence(posterior, prior, free, representation);
    }
    let op = Balanced { free: free as f32, representation: representation as f32 };
    posterior.contiguous()?.apply_op2(&prior.contiguous()?, op)
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

/// The terms of the divergence in one dimension of the latent state.
struct Terms {
    /// Difference of the means.
    distance: f32,
    /// Ratio of the variances.
    ratio: f32,
    /// Inverse of the prior's variance.
    precision: f32,
    /// Difference of the log-variances: that of the prior, less that of the posterior.
    log_ratio: f32,
}

impl Terms {
    #[inline(always)]
    fn new(mean: f32, log_variance: f32, prior_mean: f32, log_prior: f32) -> Self {
        let log_ratio = log_prior - log_variance;
        Self { distance: mean - prior_mean, ratio: exp(-log_ratio), precision: exp(-log_prior), log_ratio }
    }

    /// The divergence, doubled.
    #[inline(always)]
    fn nats(&self) -> f32 {
        self.log_ratio + self.ratio + self.distance * self.distance * self.precision - 1.0
    }
}

struct Balanced {
    free: f32,
    representation: f32,
}

impl Balanced {
    /// Returns the divergence of each row, `[batch]`. Both distributions are `[batch, width]`.
    fn nats(posterior: &[f32], prior: &[f32], width: usize) -> Vec<f32> {
        let mut terms = vec![0.0; width / 2];
        let rows = posterior.chunks_exact(width).zip(prior.chunks_exact(width));
        let of_row = |(posterior, prior): (&[f32], &[f32])| {
            let ((mean, log), (prior_mean, log_prior)) =
                (posterior.split_at(width / 2), prior.split_at(width / 2));
            simd(
                #[inline(always)]
                || {
                    let both = mean.iter().zip(log).zip(prior_mean.iter().zip(log_prior));
                    for (term, ((mean, log), (prior_mean, log_prior))) in terms.iter_mut().zip(both) {
                        *term = Terms::new(*mean, *log, *prior_mean, *log_prior).nats();
                    }
                },
            );
            0.5 * kernels::sum(&terms)
        };
        rows.map(of_row).collect()
    }

    /// Computes the gradients of both distributions in one row, whose divergence has the gradient `grad`.
    fn row_gradients(
        &self,
        [posterior, prior]: [&[f32]; 2],
        [of_posterior, of_prior]: [&mut [f32]; 2],
        grad: f32,
    ) {
        let latent = prior.len() / 2;
        let ((mean, log), (prior_mean, log_prior)) = (posterior.split_at(latent), prior.split_at(latent));
        let (of_mean, of_log) = of_posterior.split_at_mut(latent);
        let (of_prior_mean, of_log_prior) = of_prior.split_at_mut(latent);
        simd(
            #[inline(always)]
            || {
                let given = mean.iter().zip(log).zip(prior_mean.iter().zip(log_prior));
                let wanted = of_mean.iter_mut().zip(of_log).zip(of_prior_mean.iter_mut().zip(of_log_prior));
                for (((of_mean, of_log), (of_prior_mean, of_log_prior)), given) in wanted.zip(given) {
                    let ((mean, log), (prior_mean, log_prior)) = given;
                    let Terms { distance, ratio, precision, .. } =
                        Terms::new(*mean, *log, *prior_mean, *log_prior);
                    let slope = grad * distance * precision;
                    *of_prior_mean = -slope;
                    *of_log_prior = 0.5 * grad * (1.0 - ratio - distance * distance * precision);
                    *of_mean = self.representation * slope;
                    *of_log = self.representation * 0.5 * grad * (ratio - 1.0);
                }
            },
        );
    }
}

impl CustomOp2 for Balanced {
    fn name(&self) -> &'static str {
        "balanced divergence"
    }

    fn cpu_fwd(
        &self,
        posterior: &CpuStorage,
        posterior_layout: &Layout,
        prior: &CpuStorage,
        prior_layout: &Layout,
    ) -> Result<(CpuStorage, Shape)> {
        let (batch, width) = posterior_layout.shape().dims2()?;
        let nats = Self::nats(slice(posterior, posterior_layout)?, slice(prior, prior_layout)?, width);
        // A divergence that is not a number stays so.
        let counted = |nats: f32| f64::from(if nats < self.free { self.free } else { nats });
        let counted: f64 = nats.into_iter().map(counted).sum();
        let loss = counted / batch as f64 * (1.0 + f64::from(self.representation));
        Ok((CpuStorage::F32(vec![loss as f32]), ().into()))
    }

    fn bwd(
        &self,
        posterior: &Tensor,
        prior: &Tensor,
        _loss: &Tensor,
        grad: &Tensor,
    ) -> Result<(Option<Tensor>, Option<Tensor>)> {
        let (batch, width) = posterior.dims2()?;
        let grad = grad.to_scalar::<f32>()? / batch as f32;
        let (mut of_posterior, mut of_prior) =
            (kernels::scratch(batch * width), kernels::scratch(batch * width));
        with_values(posterior, |posterior| {
            with_values(prior, |prior| {
                let nats = Self::nats(posterior, prior, width);
                let given = posterior.chunks_exact(width).zip(prior.chunks_exact(width));
                let wanted = of_posterior.chunks_exact_mut(width).zip(of_prior.chunks_exact_mut(width));
                for (((posterior, prior), (of_posterior, of_prior)), nats) in given.zip(wanted).zip(nats) {
                    if nats > self.free {
                        self.row_gradients([posterior, prior], [of_posterior, of_prior], grad);
                    }
                }
                Ok(())
            })
        })?;
        Ok((Some(tensor(of_posterior, (batch, width))?), Some(tensor(of_prior, (batch, width))?)))
    }
}
