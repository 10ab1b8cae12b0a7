//! The decoder's path to frames as one op: a fully connected layer with a ReLU, chained transposed convolutions with a
//! ReLU between each two, and the mean squared error.
//!
//! Each thread holds only sixteen predicted frames and their gradients at a time, in cache. The loss is a scalar, so
//! its gradients are known up to a factor as soon as it is computed. They are therefore computed in the forward pass,
//! and overwrite the output of the fully connected layer.

use super::stack::{Layer, Side, StackSums, part_len, sum_packed};
use super::{FrameDecoder, slice, tensor, threads, with_values};
use crate::frames::Frames;
use candle_core::{CpuStorage, CustomOp3, Layout, Result, Shape, Tensor};
use harness_kernels::convolution::{Images, LANES};
use harness_kernels::product::{Accumulate, Matrix, product};
use harness_kernels::{self as kernels, Buffer, add_to};
use rayon::prelude::*;
use std::sync::{Arc, Mutex};

impl FrameDecoder {
    /// Returns `hidden weightᵀ`, `[batch, values of the stack's last layer]`, without the bias.
    fn coarse(&self, hidden: &[f32], weight: &[f32]) -> Result<Buffer> {
        let (outputs, inputs) = self.weight.dims2()?;
        let batch = hidden.len() / inputs;
        let mut coarse = Buffer::new(batch * outputs);
        let (hidden, weight) =
            (Matrix::plain(hidden, batch, inputs), Matrix::transposed(weight, outputs, inputs));
        product(hidden, weight, &mut coarse, Accumulate::Overwrite, self.arithmetic, threads());
        Ok(coarse)
    }
}

/// Decodes frames from `hidden` `[batch, hidden]`, and returns their mean squared error against `target` over all
/// values of the batch, a scalar.
pub fn frame_loss(hidden: &Tensor, decoder: FrameDecoder, target: Arc<dyn Frames>) -> Result<Tensor> {
    #[cfg(feature = "cuda")]
    if hidden.device().is_cuda() {
        return crate::cuda::frame_loss(hidden, decoder, target);
    }
    let (weight, packed) = (decoder.weight.contiguous()?, decoder.packed.clone());
    let trained = [hidden, &weight, &packed].iter().any(|tensor| tensor.track_op());
    let op = FrameLoss { decoder, target, trained, gradients: Mutex::new(None) };
    hidden.contiguous()?.apply_op3(&weight, &packed, op)
}

/// Decodes frames from `hidden` `[batch, hidden]`, and returns `[batch, frame channels, rows, columns]`. The result
/// has no gradient.
pub fn frame_decoder(hidden: &Tensor, decoder: &FrameDecoder) -> Result<Tensor> {
    #[cfg(feature = "cuda")]
    if hidden.device().is_cuda() {
        return crate::cuda::frame_decoder(hidden, decoder);
    }
    let mut coarse =
        with_values(hidden, |hidden| with_values(&decoder.weight, |weight| decoder.coarse(hidden, weight)))?;
    let (stack, batch) = (&decoder.stack, hidden.dim(0)?);
    let mut frames = kernels::scratch(batch * stack.fine_len());
    with_values(&decoder.packed, |packed| {
        let (layers, bias) = stack.unpack(Side::Decoder, packed);
        let groups = frames.par_chunks_mut(LANES * stack.fine_len());
        groups.zip(coarse.par_chunks_mut(LANES * stack.coarse_len())).for_each_init(
            || stack.levels(),
            |levels, (frames, coarse)| {
                forward(&layers, bias, coarse, levels);
                levels[0].write(frames);
            },
        );
        Ok(())
    })?;
    let first = &stack.layers()[0];
    let [rows, columns] = first.size;
    tensor(frames, (batch, first.fine_channels, rows, columns))
}

/// Computes the images at all levels, from the last level to the first. `coarse` is the output of the fully connected
/// layer, to which its bias and the ReLU are applied in place.
fn forward(layers: &[Layer], bias: &[f32], coarse: &mut [f32], levels: &mut [Images]) {
    kernels::add_bias_to_rows(coarse, bias, true);
    levels[layers.len()].set(coarse);
    for (index, layer) in layers.iter().enumerate().rev() {
        let (fine, coarse) = levels.split_at_mut(index + 1);
        layer.sizes.spread(&coarse[0], &layer.spreading, &mut fine[index]);
        fine[index].add_bias(layer.bias, index > 0);
    }
}

struct FrameLoss {
    decoder: FrameDecoder,
    target: Arc<dyn Frames>,
    /// Whether any argument needs a gradient.
    trained: bool,
    /// Computed by the forward pass, and taken by the backward pass.
    gradients: Mutex<Option<Gradients>>,
}

/// Gradients of the arguments, for a loss whose own gradient is 1.
struct Gradients {
    hidden: Vec<f32>,
    weight: Vec<f32>,
    packed: Vec<f32>,
}

/// Contribution of one part of the batch to the sums.
struct Part {
    squared_error: f64,
    /// Gradient of the packed parameters; empty if no gradient is needed.
    packed: Vec<f32>,
}

/// A thread's buffers for sixteen images.
struct Workspace {
    frames: Vec<f32>,
    target: Images,
    levels: Vec<Images>,
    /// Gradients of all levels except the first one, whose values are replaced by their gradient.
    gradients: Vec<Images>,
}

impl FrameLoss {
    fn workspace(&self) -> Workspace {
        let stack = &self.decoder.stack;
        Workspace {
            frames: kernels::scratch(LANES * stack.fine_len()),
            target: stack.layers()[0].fine(),
            levels: stack.levels(),
            gradients: if self.trained { stack.levels().split_off(1) } else { Vec::new() },
        }
    }

    /// Computes the part of the batch that starts at image `first`. `coarse` is the output of the fully connected
    /// layer, without bias and ReLU. If gradients are needed, the gradient of that output replaces it.
    fn part(
        &self,
        workspace: &mut Workspace,
        first: usize,
        coarse: &mut [f32],
        (layers, bias): (&[Layer], &[f32]),
    ) -> Part {
        let stack = &self.decoder.stack;
        let (len, frame_len) = (stack.coarse_len(), stack.fine_len());
        let scale = 2.0 / (self.target.batch() * frame_len) as f32;
        let mut sums = StackSums::new(stack, Side::Decoder);
        let mut bias_sums = vec![0.0; bias.len()];
        let mut squared_error = 0.0;
        let Workspace { frames, target, levels, gradients } = workspace;
        for (group, coarse) in coarse.chunks_mut(LANES * len).enumerate() {
            let images = coarse.len() / len;
            forward(layers, bias, coarse, levels);
            let frames = &mut frames[..images * frame_len];
            for (index, frame) in frames.chunks_exact_mut(frame_len).enumerate() {
                self.target.write(first + group * LANES + index, frame);
            }
            target.set(frames);
            squared_error += levels[0].become_errors(target, images, scale);
            if self.trained {
                for (index, Layer { sizes, convolving, .. }) in layers.iter().enumerate() {
                    let (finer, coarser) = gradients.split_at_mut(index);
                    let fine = finer.last().unwrap_or(&levels[0]);
                    sums.add(index, sizes, fine, &levels[index + 1], fine);
                    sizes.convolve(fine, convolving, &mut coarser[0]);
                    coarser[0].mask(&levels[index + 1]);
                }
                gradients[layers.len() - 1].write(coarse);
                coarse.chunks_exact(len).for_each(|grad| add_to(&mut bias_sums, grad));
            }
        }
        let packed = if self.trained { [sums.packed(), bias_sums].concat() } else { Vec::new() };
        Part { squared_error, packed }
    }

    /// Returns the gradients of all arguments, given the gradient of the fully connected layer's output before the
    /// ReLU.
    fn gradients(&self, hidden: &[f32], weight: &[f32], grad: &[f32], parts: Vec<Part>) -> Result<Gradients> {
        let ((outputs, inputs), batch) = (self.decoder.weight.dims2()?, self.target.batch());
        let arithmetic = self.decoder.arithmetic;
        let mut grad_hidden = kernels::scratch(batch * inputs);
        let (plain, weight) = (Matrix::plain(grad, batch, outputs), Matrix::plain(weight, outputs, inputs));
        product(plain, weight, &mut grad_hidden, Accumulate::Overwrite, arithmetic, threads());
        let mut grad_weight = kernels::scratch(outputs * inputs);
        let (transposed, hidden) =
            (Matrix::transposed(grad, batch, outputs), Matrix::plain(hidden, batch, inputs));
        product(transposed, hidden, &mut grad_weight, Accumulate::Overwrite, arithmetic, threads());
        let packed = sum_packed(parts.into_iter().map(|part| part.packed).collect());
        Ok(Gradients { hidden: grad_hidden, weight: grad_weight, packed })
    }
}

impl CustomOp3 for FrameLoss {
    fn name(&self) -> &'static str {
        "frame-loss"
    }

    fn cpu_fwd(
        &self,
        hidden: &CpuStorage,
        hidden_layout: &Layout,
        weight: &CpuStorage,
        weight_layout: &Layout,
        packed: &CpuStorage,
        packed_layout: &Layout,
    ) -> Result<(CpuStorage, Shape)> {
        let (hidden, weight) = (slice(hidden, hidden_layout)?, slice(weight, weight_layout)?);
        let packed = slice(packed, packed_layout)?;
        let (batch, stack) = (self.target.batch(), &self.decoder.stack);
        let mut coarse = self.decoder.coarse(hidden, weight)?;
        let part = part_len(batch);
        let (layers, bias) = stack.unpack(Side::Decoder, packed);
        let parts = coarse.par_chunks_mut(part * stack.coarse_len()).enumerate();
        let parts: Vec<Part> = parts
            .map_init(
                || self.workspace(),
                |workspace, (index, coarse)| self.part(workspace, index * part, coarse, (&layers, bias)),
            )
            .collect();
        let squared_error: f64 = parts.iter().map(|part| part.squared_error).sum();
        let mean = squared_error / (batch * stack.fine_len()) as f64;
        if self.trained {
            let gradients = self.gradients(hidden, weight, &coarse, parts)?;
            *self.gradients.lock().unwrap_or_else(|poisoned| poisoned.into_inner()) = Some(gradients);
        }
        Ok((CpuStorage::F32(vec![mean as f32]), ().into()))
    }

    fn bwd(
        &self,
        hidden: &Tensor,
        weight: &Tensor,
        packed: &Tensor,
        _loss: &Tensor,
        grad: &Tensor,
    ) -> Result<(Option<Tensor>, Option<Tensor>, Option<Tensor>)> {
        let gradients = self.gradients.lock().unwrap_or_else(|poisoned| poisoned.into_inner()).take();
        let Some(gradients) = gradients else {
            candle_core::bail!("the frame loss's gradients were already taken; run its forward pass again")
        };
        let factor = grad.to_scalar::<f32>()?;
        let scaled = |mut values: Vec<f32>, like: &Tensor| {
            if factor != 1.0 {
                values.par_iter_mut().for_each(|value| *value *= factor);
            }
            tensor(values, like.shape()).map(Some)
        };
        Ok((
            scaled(gradients.hidden, hidden)?,
            scaled(gradients.weight, weight)?,
            scaled(gradients.packed, packed)?,
        ))
    }
}
