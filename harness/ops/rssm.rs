//! The steps of a recurrent state-space model over whole sequences as one op.
//!
//! The latent state of each time depends on the one before it, so its products can't be computed for all times at once.
//! The products with actions and encoded samples can, and so can the gradients of all weights. The weights that are
//! used at each time are packed once, and each thread takes its sequences through all times, as in a gated recurrent
//! unit.

use super::arguments::Sizes;
use super::gru::{Parts, fill_rows, gradients, next_states};
use super::linear::weight_gradient;
use super::posterior::{add_gradients, draw};
use super::{Arithmetic, Sequences, StateSpace, linear, slice, tensor, threads, with_values};
use candle_core::{CpuStorage, CustomOp3, Layout, Result, Shape, Tensor, bail};
use harness_kernels::product::Matrix;
use harness_kernels::repeated::Repeated;
use harness_kernels::{self as kernels, Buffer};
use rayon::prelude::*;
use std::sync::OnceLock;

/// Returns the memory after each time, `[times * batch, width]`, and the distribution of its latent state,
/// `[times * batch, 2 * latent]`, the means followed by the log-variances.
///
/// The memory is that of a gated recurrent unit (see [`gru`](super::gru())), which takes the last latent state and the
/// action after it. The latent state is drawn as in [`sample`]. `memory` `[batch, width]` and `latent`
/// `[batch, latent]` are those before the first time.
pub fn rssm(
    given: &Sequences,
    parameters: &StateSpace,
    memory: &Tensor,
    latent: &Tensor,
    arithmetic: Arithmetic,
) -> Result<(Tensor, Tensor)> {
    let (rows, (batch, width), (_, size)) = (given.actions.dim(0)?, memory.dims2()?, latent.dims2()?);
    let StateSpace { input, hidden, distribution } = parameters;
    // A unit of the latent state alone takes no actions.
    let takes_actions = input.weight.dim(1)? > size;
    let actions = if takes_actions { given.actions.dim(1)? } else { 0 };
    let (gates, units) = (3 * width, distribution.hidden_weight.dim(0)?);
    let wanted = [
        (latent, vec![batch, size]),
        (input.weight, vec![gates, size + actions]),
        (hidden.weight, vec![gates, width]),
        (hidden.bias, vec![gates]),
        (distribution.weight, vec![2 * size, units]),
        (distribution.bias, vec![2 * size]),
    ];
    let columns = distribution.hidden_weight.dim(1)?.saturating_sub(width);
    let encoded = given.encoded.map(|encoded| (encoded, vec![rows, columns]));
    let noise = given.noise.map(|noise| (noise, vec![rows, size]));
    for (tensor, shape) in wanted.into_iter().chain(encoded).chain(noise) {
        if tensor.dims() != shape {
            bail!("a tensor of a state-space model has the shape {:?} instead of {shape:?}", tensor.dims());
        }
    }
    if batch == 0 || rows == 0 || rows % batch != 0 {
        bail!("{rows} actions can't be divided among {batch} sequences");
    }
    let part = |weight: &Tensor, first: usize, columns: usize| weight.narrow(1, first, columns);
    // The parts of the products that do not depend on the last time.
    let of_actions = match takes_actions {
        true => {
            let weight = part(input.weight, size, actions)?;
            linear(given.actions, &weight, input.bias, false, arithmetic)?
        }
        false => input.bias.broadcast_as((rows, gates))?.contiguous()?,
    };
    let of_encoded = match given.encoded {
        Some(encoded) => {
            let weight = part(distribution.hidden_weight, width, columns)?;
            linear(encoded, &weight, distribution.hidden_bias, false, arithmetic)?
        }
        None => distribution.hidden_bias.broadcast_as((rows, units))?,
    };
    let sizes = Sizes { batch, times: rows / batch, width, units, latent: size, arithmetic };
    // candle gives an op at most three arguments and takes one result.
    let packed = [
        &part(input.weight, 0, size)?,
        hidden.weight,
        hidden.bias,
        &part(distribution.hidden_weight, 0, width)?,
        distribution.weight,
        distribution.bias,
        memory,
        latent,
    ];
    let packed = packed.map(Tensor::flatten_all).into_iter().collect::<Result<Vec<_>>>()?;
    let noise = given.noise.map(Tensor::contiguous).transpose()?;
    let results = steps(&of_actions, &of_encoded.contiguous()?, &Tensor::cat(&packed, 0)?, noise, sizes)?;
    let (memories, distributions) = (rows * width, rows * 2 * size);
    Ok((
        results.narrow(0, 0, memories)?.reshape((rows, width))?,
        results.narrow(0, memories, distributions)?.reshape((rows, 2 * size))?,
    ))
}

/// Computes the memories and the distributions, one after the other, from the parts of the products that do not depend
/// on the last time. `packed` holds the other parameters and the states before the first time (see [`Sizes::packed`]).
fn steps(
    of_actions: &Tensor,
    of_encoded: &Tensor,
    packed: &Tensor,
    noise: Option<Tensor>,
    sizes: Sizes,
) -> Result<Tensor> {
    #[cfg(feature = "cuda")]
    if of_actions.device().is_cuda() {
        return crate::cuda::rssm(of_actions, of_encoded, packed, noise, sizes);
    }
    of_actions.apply_op3(of_encoded, packed, Op { sizes, noise, kept: OnceLock::new() })
}

struct Op {
    sizes: Sizes,
    noise: Option<Tensor>,
    /// Kept for the backward pass.
    kept: OnceLock<Kept>,
}

/// What the steps compute beside their results, for all times.
struct Kept {
    /// The unit's products with its inputs, `[times * batch, 3 * width]`.
    input: Buffer,
    /// The unit's products with the last memory, `[times * batch, 3 * width]`.
    product: Buffer,
    /// The hidden layer's output, `[times * batch, units]`.
    hidden: Buffer,
    /// The latent states, `[times * batch, latent]`.
    latent: Buffer,
}

/// Splits values into parts of these lengths.
fn split<const N: usize>(mut values: &[f32], lens: [usize; N]) -> [&[f32]; N] {
    lens.map(|len| {
        let (part, rest) = values.split_at(len);
        values = rest;
        part
    })
}

/// Splits values into parts of these lengths.
fn split_mut<const N: usize>(mut values: &mut [f32], lens: [usize; N]) -> [&mut [f32]; N] {
    lens.map(|len| {
        let (part, rest) = std::mem::take(&mut values).split_at_mut(len);
        values = rest;
        part
    })
}

impl Sizes {
    /// Prepares a product at each time.
    fn repeated(self, matrix: Matrix) -> Repeated {
        Repeated::new(matrix, self.times, self.arithmetic)
    }

    /// Computes the results of all times.
    fn forward(
        self,
        [of_actions, of_encoded]: [&[f32]; 2],
        packed: &[f32],
        noise: Option<&[f32]>,
        results: &mut [f32],
    ) -> Kept {
        let Self { width, units, latent, .. } = self;
        let (gates, rows) = (self.gates(), self.rows());
        let [
            latent_weight,
            memory_weight,
            memory_bias,
            hidden_weight,
            weight,
            bias,
            memory_start,
            latent_start,
        ] = split(packed, self.packed());
        let transposed = |weight, outputs, inputs| self.repeated(Matrix::transposed(weight, outputs, inputs));
        let latent_product = transposed(latent_weight, gates, latent);
        let memory_product = transposed(memory_weight, gates, width);
        let hidden_product = transposed(hidden_weight, units, width);
        let distribution_product = transposed(weight, 2 * latent, units);

        let mut kept = Kept {
            input: Buffer::new(rows * gates),
            product: Buffer::new(rows * gates),
            hidden: Buffer::new(rows * units),
            latent: Buffer::new(rows * latent),
        };
        let [memories, distributions] = split_mut(results, self.results());
        let parts = Parts::new(self.batch, &memory_product);
        let of_parts = parts.of_mut([
            (&mut kept.input, gates),
            (&mut kept.product, gates),
            (&mut kept.hidden, units),
            (&mut kept.latent, latent),
            (memories, width),
            (distributions, 2 * latent),
        ]);
        of_parts.into_par_iter().enumerate().for_each(|(part, times)| {
            let mut last_memory = parts.of(memory_start, width, part, 0);
            let mut last_latent = parts.of(latent_start, latent, part, 0);
            for (time, [input, product, hidden, drawn, memory, distribution]) in times.into_iter().enumerate()
            {
                input.copy_from_slice(parts.of(of_actions, gates, part, time));
                latent_product.add_product(last_latent, input, threads());
                fill_rows(product, memory_bias);
                memory_product.add_product(last_memory, product, threads());
                next_states([input, product, last_memory], memory, width);
                hidden.copy_from_slice(parts.of(of_encoded, units, part, time));
                hidden_product.add_product(memory, hidden, threads());
                hidden.iter_mut().for_each(|value| *value = value.max(0.0));
                fill_rows(distribution, bias);
                distribution_product.add_product(hidden, distribution, threads());
                match noise {
                    Some(noise) => draw(distribution, parts.of(noise, latent, part, time), drawn, latent),
                    None => copy_means(distribution, drawn, latent),
                }
                (last_memory, last_latent) = (memory, drawn);
            }
        });
        kept
    }

    /// Computes the gradients of the op's arguments. `grad` is the gradient of the results. `is_drawn` says whether the
    /// latent states are drawn or means.
    fn backward(
        self,
        kept: &Kept,
        packed: &[f32],
        results: &[f32],
        grad: &[f32],
        is_drawn: bool,
    ) -> [Vec<f32>; 3] {
        let Self { width, units, latent, .. } = self;
        let (gates, rows) = (self.gates(), self.rows());
        let [latent_weight, memory_weight, _, hidden_weight, weight, _, memory_start, latent_start] =
            split(packed, self.packed());
        let [grad_memory, grad_distribution] = split(grad, self.results());
        let [memories, distributions] = split(results, self.results());
        // The values before each time.
        let (last_memory, last_latent) = (before(memory_start, memories), before(latent_start, &kept.latent));
        let plain = |weight, rows, columns| self.repeated(Matrix::plain(weight, rows, columns));
        let latent_product = plain(latent_weight, gates, latent);
        let memory_product = plain(memory_weight, gates, width);
        let hidden_product = plain(hidden_weight, units, width);
        let distribution_product = plain(weight, 2 * latent, units);

        let (mut of_input, mut of_hidden) = (kernels::scratch(rows * gates), kernels::scratch(rows * units));
        let (mut of_product, mut of_distribution) =
            (Buffer::new(rows * gates), Buffer::new(rows * 2 * latent));
        of_distribution.copy_from_slice(grad_distribution);
        let mut of_packed = vec![0.0; self.packed().iter().sum()];
        let [
            of_latent_weight,
            of_memory_weight,
            of_memory_bias,
            of_hidden_weight,
            of_weight,
            of_bias,
            of_memory,
            of_latent,
        ] = split_mut(&mut of_packed, self.packed());
        let parts = Parts::new(self.batch, &memory_product);
        let of_times = parts.of_mut([
            (&mut of_input, gates),
            (&mut of_product, gates),
            (&mut of_hidden, units),
            (&mut of_distribution, 2 * latent),
        ]);
        let of_starts =
            of_memory.par_chunks_mut(parts.rows * width).zip(of_latent.par_chunks_mut(parts.rows * latent));
        let of_parts = of_times.into_par_iter().zip(of_starts).enumerate();
        of_parts.for_each(|(part, (times, (of_memory, of_latent)))| {
            let of_times = times.into_iter().enumerate().rev();
            for (time, [of_input, of_product, of_hidden, of_distribution]) in of_times {
                let now = |values, columns| parts.of(values, columns, part, time);
                if is_drawn {
                    let drawn = [now(distributions, 2 * latent), now(&kept.latent, latent), of_latent];
                    add_gradients(drawn, of_distribution, latent);
                } else {
                    add_to_means(of_latent, of_distribution, latent);
                }
                distribution_product.add_product(of_distribution, of_hidden, threads());
                kernels::mask(of_hidden, now(&kept.hidden, units));
                kernels::add_to(of_memory, now(grad_memory, width));
                hidden_product.add_product(of_hidden, of_memory, threads());
                let unit = [now(&kept.input, gates), now(&kept.product, gates), now(&last_memory, width)];
                gradients(unit, [&mut *of_input, &mut *of_product], of_memory, width);
                memory_product.add_product(of_product, of_memory, threads());
                of_latent.fill(0.0);
                latent_product.add_product(of_input, of_latent, threads());
            }
        });

        let weights = [
            (&*of_input, &*last_latent, [gates, latent], of_latent_weight),
            (&*of_product, &*last_memory, [gates, width], of_memory_weight),
            (&*of_hidden, memories, [units, width], of_hidden_weight),
            (&*of_distribution, &*kept.hidden, [2 * latent, units], of_weight),
        ];
        for (grad, rows, shape, wanted) in weights {
            weight_gradient(grad, rows, shape, wanted, self.arithmetic);
        }
        of_memory_bias.copy_from_slice(&kernels::column_sums(&of_product, gates));
        of_bias.copy_from_slice(&kernels::column_sums(&of_distribution, 2 * latent));
        [of_input, of_hidden, of_packed]
    }
}

/// Sets latent states to the means of their distributions.
fn copy_means(distributions: &[f32], latents: &mut [f32], latent: usize) {
    let rows = latents.chunks_exact_mut(latent).zip(distributions.chunks_exact(2 * latent));
    rows.for_each(|(latents, distribution)| latents.copy_from_slice(&distribution[..latent]));
}

/// Adds the gradients of means to those of their distributions.
fn add_to_means(of_latents: &[f32], of_distributions: &mut [f32], latent: usize) {
    let rows = of_distributions.chunks_exact_mut(2 * latent).zip(of_latents.chunks_exact(latent));
    rows.for_each(|(of_distribution, of_latents)| {
        kernels::add_to(&mut of_distribution[..latent], of_latents)
    });
}

/// Returns the values before each time: those at the start, and those of all times but the last.
fn before(start: &[f32], values: &[f32]) -> Vec<f32> {
    [start, &values[..values.len() - start.len()]].concat()
}

impl CustomOp3 for Op {
    fn name(&self) -> &'static str {
        "rssm"
    }

    fn cpu_fwd(
        &self,
        of_actions: &CpuStorage,
        of_actions_layout: &Layout,
        of_encoded: &CpuStorage,
        of_encoded_layout: &Layout,
        packed: &CpuStorage,
        packed_layout: &Layout,
    ) -> Result<(CpuStorage, Shape)> {
        let given = [slice(of_actions, of_actions_layout)?, slice(of_encoded, of_encoded_layout)?];
        let packed = slice(packed, packed_layout)?;
        let mut results = kernels::scratch(self.sizes.results().iter().sum());
        let mut forward = |noise: Option<&[f32]>| self.sizes.forward(given, packed, noise, &mut results);
        let kept = match &self.noise {
            Some(noise) => with_values(noise, |noise| Ok(forward(Some(noise))))?,
            None => forward(None),
        };
        self.kept.get_or_init(|| kept);
        let len = results.len();
        Ok((CpuStorage::F32(results), len.into()))
    }

    fn bwd(
        &self,
        of_actions: &Tensor,
        of_encoded: &Tensor,
        packed: &Tensor,
        results: &Tensor,
        grad: &Tensor,
    ) -> Result<(Option<Tensor>, Option<Tensor>, Option<Tensor>)> {
        let Some(kept) = self.kept.get() else { bail!("the steps have no products to go back from") };
        let is_drawn = self.noise.is_some();
        let [actions, encoded, others] = with_values(packed, |packed| {
            with_values(results, |results| {
                with_values(grad, |grad| Ok(self.sizes.backward(kept, packed, results, grad, is_drawn)))
            })
        })?;
        Ok((
            Some(tensor(actions, of_actions.shape())?),
            Some(tensor(encoded, of_encoded.shape())?),
            Some(tensor(others, packed.shape())?),
        ))
    }
}
