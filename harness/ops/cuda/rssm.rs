//! The steps of a recurrent state-space model over whole sequences.

use super::recurrent::{Recurrence, Weight, recur, weight_gradient};
use super::{Gpu, Matrix, not_on_cpu, slice, with_values, write_column_sums};
use crate::arguments::Sizes;
use candle_core::cuda::cudarc::driver::{CudaSlice, CudaView, DeviceRepr};
use candle_core::{CudaStorage, CustomOp3, Layout, Result, Shape, Tensor, bail};
use std::ops::Range;
use std::sync::OnceLock;

/// Returns the memories and the distributions, one after the other. `packed` holds the parameters and the states before
/// the first time (see [`Sizes::packed`]).
pub fn rssm(
    of_actions: &Tensor,
    of_encoded: &Tensor,
    packed: &Tensor,
    noise: Option<Tensor>,
    sizes: Sizes,
) -> Result<Tensor> {
    of_actions.apply_op3(of_encoded, packed, Rssm { sizes, noise, kept: OnceLock::new() })
}

struct Rssm {
    sizes: Sizes,
    noise: Option<Tensor>,
    /// Kept for the backward pass.
    kept: OnceLock<Kept>,
}

/// What the steps compute beside their results, for all times.
struct Kept {
    /// The gates and the candidate's product with the last memory, `[times * batch, width, 4]`.
    gates: CudaSlice<f32>,
    /// The hidden layer's output, `[times * batch, units]`.
    hidden: CudaSlice<f32>,
    /// The latent states, `[times * batch, latent]`.
    latent: CudaSlice<f32>,
}

/// Sizes of a model. The fields are those of `recurrent.cu`.
#[repr(C)]
#[derive(Clone, Copy)]
struct Model {
    width: i32,
    units: i32,
    latent: i32,
}

// SAFETY: the kernels declare a structure with the same fields.
unsafe impl DeviceRepr for Model {}

/// Returns the ranges of values of these lengths that follow one another.
fn ranges<const N: usize>(lens: [usize; N]) -> [Range<usize>; N] {
    let mut end = 0;
    lens.map(|len| {
        end += len;
        end - len..end
    })
}

impl Rssm {
    fn model(&self) -> Model {
        let Sizes { width, units, latent, .. } = self.sizes;
        Model { width: width as i32, units: units as i32, latent: latent as i32 }
    }

    /// Computes the gradients of the weights and biases from those of the products.
    fn parameter_gradients(
        &self,
        gpu: &Gpu,
        kept: &Kept,
        [packed, memories]: [&CudaView<f32>; 2],
        [of_input, of_product, of_hidden, of_distribution]: [&CudaView<f32>; 4],
        of_packed: &mut CudaSlice<f32>,
    ) -> Result<()> {
        let Sizes { batch, width, units, latent, arithmetic, .. } = self.sizes;
        let rows = self.sizes.rows();
        let [of_latent, of_memory, of_memory_bias, of_hidden_weight, of_weight, of_bias, memory, latents] =
            ranges(self.sizes.packed());
        let (hidden, drawn) = (kept.hidden.as_view(), kept.latent.as_view());
        let before = [
            (of_input, latents, &drawn, of_latent, latent),
            (of_product, memory, memories, of_memory, width),
        ];
        for (grad, start, values, wanted, columns) in before {
            let (given, mut wanted) = ([&packed.slice(start), values], of_packed.slice_mut(wanted));
            weight_gradient(gpu, grad, given, &mut wanted, [batch, columns], arithmetic)?;
        }
        let distribution = 2 * latent;
        let now = [
            (of_hidden, units, memories, width, of_hidden_weight),
            (of_distribution, distribution, &hidden, units, of_weight),
        ];
        for (grad, outputs, values, columns, wanted) in now {
            let (grad, values) =
                (Matrix::transposed(grad, rows, outputs), Matrix::plain(values, rows, columns));
            gpu.product(grad, values, &mut of_packed.slice_mut(wanted), false, arithmetic)?;
        }
        for (grad, wanted) in [(of_product, of_memory_bias), (of_distribution, of_bias)] {
            write_column_sums(gpu, grad, &mut of_packed.slice_mut(wanted))?;
        }
        Ok(())
    }
}

impl CustomOp3 for Rssm {
    fn name(&self) -> &'static str {
        "rssm"
    }

    not_on_cpu!(CpuStorage, CpuStorage, CpuStorage);

    fn cuda_fwd(
        &self,
        of_actions: &CudaStorage,
        of_actions_layout: &Layout,
        of_encoded: &CudaStorage,
        of_encoded_layout: &Layout,
        packed: &CudaStorage,
        packed_layout: &Layout,
    ) -> Result<(CudaStorage, Shape)> {
        let Sizes { batch, times, width, units, latent, .. } = self.sizes;
        let (gpu, rows, gates) = (Gpu::with(of_actions), self.sizes.rows(), self.sizes.gates());
        let (of_actions, of_encoded) =
            (slice(of_actions, of_actions_layout)?, slice(of_encoded, of_encoded_layout)?);
        let packed = slice(packed, packed_layout)?;
        let [memories_len, distributions_len] = self.sizes.results();
        let mut results = gpu.scratch(memories_len + distributions_len)?;
        let (mut memories, mut distributions) = results.split_at_mut(memories_len);
        let mut kept = Kept {
            gates: gpu.scratch(rows * 4 * width)?,
            hidden: gpu.scratch(rows * units)?,
            latent: gpu.scratch(rows * latent)?,
        };
        let weights = [
            Weight { outputs: width, len: gates },
            Weight { outputs: width, len: 3 * latent },
            Weight { outputs: units, len: width },
            Weight { outputs: latent, len: 2 * units },
        ];
        let longest = width.max(units).max(latent);
        let recurrence = Recurrence::new(&gpu, [batch, times], longest, &weights)?;
        let launch = |noise: &CudaView<f32>| {
            recur!(
                recurrence,
                "rssm_forward",
                &self.model(),
                &of_actions,
                &of_encoded,
                &packed,
                noise,
                &i32::from(self.noise.is_some()),
                &mut memories,
                &mut distributions,
                &mut kept.gates,
                &mut kept.hidden,
                &mut kept.latent
            );
            Ok(())
        };
        match &self.noise {
            Some(noise) => with_values(noise, launch)?,
            // The kernel does not read the noise of states that are not drawn.
            None => launch(&of_actions)?,
        }
        self.kept.get_or_init(|| kept);
        Ok(gpu.storage(results, memories_len + distributions_len))
    }

    fn bwd(
        &self,
        of_actions: &Tensor,
        of_encoded: &Tensor,
        packed: &Tensor,
        results: &Tensor,
        grad: &Tensor,
    ) -> Result<(Option<Tensor>, Option<Tensor>, Option<Tensor>)> {
        let Some(kept) = self.kept.get() else { bail!("the steps have no gates to go back from") };
        let Sizes { batch, times, width, units, latent, .. } = self.sizes;
        let (gpu, rows, gates) = (Gpu::of(of_actions)?, self.sizes.rows(), self.sizes.gates());
        let (mut of_input, mut of_product) = (gpu.scratch(rows * gates)?, gpu.scratch(rows * gates)?);
        let (mut of_hidden, mut of_distribution) =
            (gpu.scratch(rows * units)?, gpu.scratch(rows * 2 * latent)?);
        let mut of_packed = gpu.scratch(packed.elem_count())?;
        let weights = [
            Weight { outputs: width, len: gates },
            Weight { outputs: latent, len: gates },
            Weight { outputs: width, len: units },
            Weight { outputs: units, len: 2 * latent },
        ];
        let longest = gates.max(units).max(2 * latent);
        let recurrence = Recurrence::new(&gpu, [batch, times], longest, &weights)?;
        let [memories_range, distributions_range] = ranges(self.sizes.results());
        with_values(packed, |packed| {
            with_values(results, |results| {
                let memories = results.slice(memories_range.clone());
                with_values(grad, |grad| {
                    recur!(
                        recurrence,
                        "rssm_backward",
                        &self.model(),
                        packed,
                        &memories,
                        &results.slice(distributions_range.clone()),
                        &grad.slice(memories_range),
                        &grad.slice(distributions_range),
                        &i32::from(self.noise.is_some()),
                        &kept.gates,
                        &kept.hidden,
                        &kept.latent,
                        &mut of_input,
                        &mut of_product,
                        &mut of_hidden,
                        &mut of_distribution,
                        &mut of_packed
                    );
                    Ok(())
                })?;
                let of_products =
                    [&of_input, &of_product, &of_hidden, &of_distribution].map(CudaSlice::as_view);
                let given = [packed, &memories];
                self.parameter_gradients(&gpu, kept, given, of_products.each_ref(), &mut of_packed)
            })
        })?;
        Ok((
            Some(gpu.tensor(of_input, of_actions.shape())),
            Some(gpu.tensor(of_hidden, of_encoded.shape())),
            Some(gpu.tensor(of_packed, packed.shape())),
        ))
    }
}
