//! The frames' way into the encoder: convolution, ReLU and the first fully connected layer's product, as one op.
//!
//! The frames are data, so no gradient is computed for them, and the activations of the convolution never pass
//! through candle's gradient store.

use super::{slice, tensor, threads, with_values};
use crate::dataset::frames::Frames;
use crate::learning::kernels::{self, Into, Matrix, PARTS, Patches, product};
use candle_core::{CpuStorage, CustomOp3, Device, Layout, Result, Shape, Tensor};
use rayon::prelude::*;
use std::sync::{Arc, OnceLock};

/// `relu(conv(frames))`, flattened channel by channel, times `hiddenᵀ`; result `[batch, hidden]`.
///
/// `kernel` `[channels, frame channels, 4, 4]` and `bias` `[channels]` make the convolution (stride 2, padding
/// 1); `hidden` is `[hidden, channels * (side / 2)²]`.
pub fn frame_encoder(
    frames: Arc<dyn Frames>,
    kernel: &Tensor,
    bias: &Tensor,
    hidden: &Tensor,
    device: &Device,
) -> Result<Tensor> {
    if device.is_cpu() {
        let channels = kernel.dim(0)?;
        let patches =
            Patches { fine_channels: frames.channels(), coarse_channels: channels, side: frames.side() };
        return kernel.apply_op3(bias, hidden, FrameEncoder { frames, patches, active: OnceLock::new() });
    }
    let frames = frames.tensor(device)?;
    let channels = kernel.dim(0)?;
    let active =
        frames.conv2d(kernel, 1, 2, 1, 1)?.broadcast_add(&bias.reshape((1, channels, 1, 1))?)?.relu()?;
    active.flatten_from(1)?.matmul(&hidden.t()?)
}

struct FrameEncoder {
    frames: Arc<dyn Frames>,
    patches: Patches,
    /// `relu(conv(frames))` `[batch, channels * positions]`, kept for the gradients.
    active: OnceLock<Vec<f32>>,
}

impl FrameEncoder {
    fn convolve(&self, kernel: &[f32], bias: &[f32]) -> Vec<f32> {
        let patches = self.patches;
        let (coarse, patch, positions) = (patches.coarse_channels, patches.patch_len(), patches.positions());
        let mut active = kernels::scratch(self.frames.batch() * patches.coarse_len());
        let part = self.frames.batch().div_ceil(PARTS);
        active.par_chunks_mut(part * patches.coarse_len()).enumerate().for_each(|(part_index, active)| {
            let mut frame = kernels::scratch(patches.fine_len());
            let mut cut = kernels::scratch(patch * positions);
            for (index, active) in active.chunks_exact_mut(patches.coarse_len()).enumerate() {
                self.frames.write(part_index * part + index, &mut frame);
                patches.cut(&frame, &mut cut);
                product(
                    Matrix::plain(kernel, coarse, patch),
                    Matrix::plain(&cut, patch, positions),
                    active,
                    Into::Overwrite,
                    1,
                );
                for (plane, bias) in active.chunks_exact_mut(positions).zip(bias) {
                    plane.iter_mut().for_each(|value| *value = (*value + bias).max(0.0));
                }
            }
        });
        active
    }

    /// Gradients of the convolution's kernel and bias, given that of its activations.
    fn convolution_gradients(&self, mut grad_active: Vec<f32>) -> (Vec<f32>, Vec<f32>) {
        let patches = self.patches;
        let (coarse, patch, positions) = (patches.coarse_channels, patches.patch_len(), patches.positions());
        let active = self.active.get().map(Vec::as_slice).unwrap_or_default();
        let part = self.frames.batch().div_ceil(PARTS);
        let sums = grad_active
            .par_chunks_mut(part * patches.coarse_len())
            .zip(active.par_chunks(part * patches.coarse_len()))
            .enumerate()
            .map(|(part_index, (grad, active))| {
                let mut frame = kernels::scratch(patches.fine_len());
                let mut cut = kernels::scratch(patch * positions);
                let (mut grad_kernel, mut grad_bias) = (vec![0.0; patches.weight_len()], vec![0.0; coarse]);
                let images = grad
                    .chunks_exact_mut(patches.coarse_len())
                    .zip(active.chunks_exact(patches.coarse_len()));
                for (index, (grad, active)) in images.enumerate() {
                    kernels::mask(grad, active);
                    self.frames.write(part_index * part + index, &mut frame);
                    patches.cut(&frame, &mut cut);
                    product(
                        Matrix::plain(grad, coarse, positions),
                        Matrix::transposed(&cut, patch, positions),
                        &mut grad_kernel,
                        Into::Add,
                        1,
                    );
                    for (sum, plane) in grad_bias.iter_mut().zip(grad.chunks_exact(positions)) {
                        *sum += plane.iter().sum::<f32>();
                    }
                }
                (grad_kernel, grad_bias)
            });
        let (kernel, bias): (Vec<_>, Vec<_>) = sums.collect::<Vec<_>>().into_iter().unzip();
        (kernels::sum_in_order(kernel, patches.weight_len()), kernels::sum_in_order(bias, coarse))
    }
}

impl CustomOp3 for FrameEncoder {
    fn name(&self) -> &'static str {
        "frame-encoder"
    }

    fn cpu_fwd(
        &self,
        kernel: &CpuStorage,
        kernel_layout: &Layout,
        bias: &CpuStorage,
        bias_layout: &Layout,
        hidden: &CpuStorage,
        hidden_layout: &Layout,
    ) -> Result<(CpuStorage, Shape)> {
        let active = self.convolve(slice(kernel, kernel_layout)?, slice(bias, bias_layout)?);
        let (batch, (outputs, inputs)) = (self.frames.batch(), hidden_layout.shape().dims2()?);
        let mut out = kernels::scratch(batch * outputs);
        product(
            Matrix::plain(&active, batch, inputs),
            Matrix::transposed(slice(hidden, hidden_layout)?, outputs, inputs),
            &mut out,
            Into::Overwrite,
            threads(),
        );
        self.active.get_or_init(|| active);
        Ok((CpuStorage::F32(out), (batch, outputs).into()))
    }

    fn bwd(
        &self,
        kernel: &Tensor,
        bias: &Tensor,
        hidden: &Tensor,
        _out: &Tensor,
        grad: &Tensor,
    ) -> Result<(Option<Tensor>, Option<Tensor>, Option<Tensor>)> {
        let (batch, (outputs, inputs)) = (self.frames.batch(), hidden.dims2()?);
        let active = self.active.get().map(Vec::as_slice).unwrap_or_default();
        let mut grad_hidden = kernels::scratch(outputs * inputs);
        let mut grad_active = kernels::scratch(batch * inputs);
        with_values(grad, |grad| {
            product(
                Matrix::transposed(grad, batch, outputs),
                Matrix::plain(active, batch, inputs),
                &mut grad_hidden,
                Into::Overwrite,
                threads(),
            );
            with_values(hidden, |hidden| {
                let grad = Matrix::plain(grad, batch, outputs);
                let hidden = Matrix::plain(hidden, outputs, inputs);
                product(grad, hidden, &mut grad_active, Into::Overwrite, threads());
                Ok(())
            })
        })?;
        let (grad_kernel, grad_bias) = self.convolution_gradients(grad_active);
        Ok((
            Some(tensor(grad_kernel, kernel.shape())?),
            Some(tensor(grad_bias, bias.shape())?),
            Some(tensor(grad_hidden, (outputs, inputs))?),
        ))
    }
}
