//! The encoder's path for frames as one op: chained convolutions, each with a ReLU, and the matrix product of the first
//! fully connected layer.
//!
//! Sixteen images pass through all layers while they are in cache. Only the activations of the last layer are kept. The
//! backward pass computes the others again, which is faster than writing and reading them. No gradient is computed for
//! the frames, because they are data.

use super::stack::{Layer, Side, Stack, StackSums, part_len, sum_packed};
use super::{Arithmetic, Dropout, slice, tensor, threads, with_values};
use crate::frames::Frames;
use candle_core::{CpuStorage, CustomOp2, Layout, Result, Shape, Tensor};
use harness_kernels::convolution::{Images, LANES};
use harness_kernels::product::{Accumulate, Matrix, product};
use harness_kernels::{self as kernels, Buffer};
use rayon::prelude::*;
use std::sync::{Arc, OnceLock};

/// Returns the product of the last layer's activations, flattened channel by channel, and `weightᵀ`:
/// `[batch, outputs]`.
///
/// `packed` holds the kernel `[channels, channels before, 4, 4]` and the bias `[channels]` of each convolution, one
/// after the other. `weight` is `[outputs, values of the last layer]`. A ReLU follows each convolution. `dropout` is
/// applied before the product.
pub fn frame_encoder(
    frames: Arc<dyn Frames>,
    stack: &Stack,
    packed: &Tensor,
    weight: &Tensor,
    arithmetic: Arithmetic,
    dropout: Option<Dropout>,
) -> Result<Tensor> {
    #[cfg(feature = "cuda")]
    if packed.device().is_cuda() {
        return crate::cuda::frame_encoder(frames, stack, packed, weight, arithmetic, dropout);
    }
    let op = FrameEncoder { frames, stack: stack.clone(), arithmetic, dropout, active: OnceLock::new() };
    packed.apply_op2(&weight.contiguous()?, op)
}

struct FrameEncoder {
    frames: Arc<dyn Frames>,
    stack: Stack,
    arithmetic: Arithmetic,
    dropout: Option<Dropout>,
    /// Activations of the last layer after dropout, `[batch, values]`, kept for the backward pass.
    active: OnceLock<Buffer>,
}

/// A thread's buffers for sixteen images.
struct Workspace {
    frames: Vec<f32>,
    levels: Vec<Images>,
}

impl Workspace {
    fn new(stack: &Stack) -> Self {
        Self { frames: kernels::scratch(LANES * stack.fine_len()), levels: stack.levels() }
    }

    /// Loads sixteen frames, or as many as are left, starting at index `first`.
    fn load(&mut self, frames: &dyn Frames, first: usize) {
        let images = (frames.batch() - first).min(LANES);
        let values = &mut self.frames[..images * frames.frame_len()];
        for (index, frame) in values.chunks_exact_mut(frames.frame_len()).enumerate() {
            frames.write(first + index, frame);
        }
        self.levels[0].set(values);
    }

    /// Applies the given layers, starting with the first one.
    fn forward(&mut self, layers: &[Layer]) {
        for (index, layer) in layers.iter().enumerate() {
            let (fine, coarse) = self.levels.split_at_mut(index + 1);
            layer.sizes.convolve(&fine[index], &layer.convolving, &mut coarse[0]);
            coarse[0].add_bias(layer.bias, true);
        }
    }
}

impl FrameEncoder {
    /// Returns the activations of the last layer after dropout, `[batch, values]`.
    fn activate(&self, packed: &[f32]) -> Buffer {
        let (layers, _) = self.stack.unpack(Side::Encoder, packed);
        let (batch, len) = (self.frames.batch(), self.stack.coarse_len());
        let part = part_len(batch);
        let mut active = Buffer::new(batch * len);
        active.par_chunks_mut(part * len).enumerate().for_each_init(
            || Workspace::new(&self.stack),
            |workspace, (part_index, active)| {
                for (group, active) in active.chunks_mut(LANES * len).enumerate() {
                    let first = part_index * part + group * LANES;
                    workspace.load(&*self.frames, first);
                    workspace.forward(&layers);
                    workspace.levels[layers.len()].write(active);
                    if let Some(dropout) = self.dropout {
                        let images = active.chunks_exact_mut(len).enumerate();
                        images.for_each(|(index, active)| dropout.apply(first + index, active));
                    }
                }
            },
        );
        active
    }

    /// Returns the gradient of the packed parameters, given the gradient of the last layer's activations.
    fn gradient(&self, packed: &[f32], active: &[f32], grad_active: &[f32]) -> Vec<f32> {
        let (layers, _) = self.stack.unpack(Side::Encoder, packed);
        let (last, len) = (layers.len(), self.stack.coarse_len());
        let part = part_len(self.frames.batch());
        let parts = grad_active.par_chunks(part * len).zip(active.par_chunks(part * len)).enumerate();
        let parts = parts.map_init(
            || (Workspace::new(&self.stack), self.stack.levels()),
            |(workspace, gradients), (part_index, (grad, active))| {
                let mut sums = StackSums::new(&self.stack, Side::Encoder);
                for (group, (grad, active)) in
                    grad.chunks(LANES * len).zip(active.chunks(LANES * len)).enumerate()
                {
                    workspace.load(&*self.frames, part_index * part + group * LANES);
                    workspace.forward(&layers[..last - 1]);
                    workspace.levels[last].set(active);
                    gradients[last].set(grad);
                    gradients[last].mask(&workspace.levels[last]);
                    for index in (0..last).rev() {
                        let (fine, coarse) = gradients.split_at_mut(index + 1);
                        let Layer { sizes, spreading, .. } = &layers[index];
                        sums.add(index, sizes, &workspace.levels[index], &coarse[0], &coarse[0]);
                        if index > 0 {
                            sizes.spread(&coarse[0], spreading, &mut fine[index]);
                            fine[index].mask(&workspace.levels[index]);
                        }
                    }
                }
                sums.packed()
            },
        );
        let mut gradient = sum_packed(parts.collect());
        if let Some(dropout) = self.dropout {
            // A value that dropout set to zero passes no gradient, like a value that the ReLU cut. The other values
            // were scaled, and their gradients are scaled likewise.
            gradient.iter_mut().for_each(|grad| *grad *= dropout.scale());
        }
        gradient
    }
}

impl CustomOp2 for FrameEncoder {
    fn name(&self) -> &'static str {
        "frame-encoder"
    }

    fn cpu_fwd(
        &self,
        packed: &CpuStorage,
        packed_layout: &Layout,
        weight: &CpuStorage,
        weight_layout: &Layout,
    ) -> Result<(CpuStorage, Shape)> {
        let active = self.activate(slice(packed, packed_layout)?);
        let (batch, (outputs, inputs)) = (self.frames.batch(), weight_layout.shape().dims2()?);
        let mut out = kernels::scratch(batch * outputs);
        let weight = Matrix::transposed(slice(weight, weight_layout)?, outputs, inputs);
        product(
            Matrix::plain(&active, batch, inputs),
            weight,
            &mut out,
            Accumulate::Overwrite,
            self.arithmetic,
            threads(),
        );
        self.active.get_or_init(|| active);
        Ok((CpuStorage::F32(out), (batch, outputs).into()))
    }

    fn bwd(
        &self,
        packed: &Tensor,
        weight: &Tensor,
        _out: &Tensor,
        grad: &Tensor,
    ) -> Result<(Option<Tensor>, Option<Tensor>)> {
        let (batch, (outputs, inputs)) = (self.frames.batch(), weight.dims2()?);
        let active = self.active.get().map(|active| &**active).unwrap_or_default();
        let mut grad_active = Buffer::new(batch * inputs);
        let mut grad_weight = kernels::scratch(outputs * inputs);
        with_values(grad, |grad| {
            let (plain, transposed) =
                (Matrix::plain(grad, batch, outputs), Matrix::transposed(grad, batch, outputs));
            let active = Matrix::plain(active, batch, inputs);
            product(transposed, active, &mut grad_weight, Accumulate::Overwrite, self.arithmetic, threads());
            with_values(weight, |weight| {
                let weight = Matrix::plain(weight, outputs, inputs);
                product(plain, weight, &mut grad_active, Accumulate::Overwrite, self.arithmetic, threads());
                Ok(())
            })
        })?;
        let gradient = with_values(packed, |packed| Ok(self.gradient(packed, active, &grad_active)))?;
        Ok((Some(tensor(gradient, packed.shape())?), Some(tensor(grad_weight, (outputs, inputs))?)))
    }
}
