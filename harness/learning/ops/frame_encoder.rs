//! The frames' way into the encoder: convolution, ReLU and the first fully connected layer's product, as one op.
//!
//! The frames are data, so no gradient is computed for them, and the activations of the convolution never pass
//! through candle's gradient store.

use super::{Dropout, hand_over, is_trained, slice, tensor, threads, with_values};
use crate::dataset::frames::Frames;
use crate::learning::kernels::convolution::{Coarse, Convolution, Fine, KernelSums};
use crate::learning::kernels::product::{Into, Matrix, product};
use crate::learning::kernels::{self, Buffer, PARTS, simd};
use crate::spec::Precision;
use candle_core::{CpuStorage, CustomOp2, Layout, Result, Shape, Tensor};
use rayon::prelude::*;
use std::sync::{Arc, OnceLock};

/// `relu(conv(frames))`, flattened channel by channel, times `hiddenᵀ`; result `[batch, hidden]`.
///
/// `kernel` `[channels, frame channels, 4, 4]` and `bias` `[channels]` make the convolution (stride 2, padding
/// 1); `hidden` is `[hidden, channels * (side / 2)²]`, a variable or detached, and its product has `precision`. With
/// `dropout`, that leaves values out before the product.
pub fn frame_encoder(
    frames: Arc<dyn Frames>,
    kernel: &Tensor,
    bias: &Tensor,
    hidden: &Tensor,
    precision: Precision,
    dropout: Option<Dropout>,
) -> Result<Tensor> {
    let (channels, device) = (kernel.dim(0)?, kernel.device());
    if device.is_cpu() {
        let sizes =
            Convolution { fine_channels: frames.channels(), coarse_channels: channels, side: frames.side() };
        let op = FrameEncoder {
            frames,
            sizes,
            hidden: hidden.clone(),
            trained: is_trained(hidden)?,
            precision,
            dropout,
            active: OnceLock::new(),
        };
        return kernel.apply_op2(bias, op);
    }
    let frames = frames.tensor(device)?;
    let active =
        frames.conv2d(kernel, 1, 2, 1, 1)?.broadcast_add(&bias.reshape((1, channels, 1, 1))?)?.relu()?;
    let mut active = active.flatten_from(1)?;
    if let Some(dropout) = dropout {
        let (batch, len) = active.dims2()?;
        let mut mask = vec![1.0; batch * len];
        mask.chunks_exact_mut(len).enumerate().for_each(|(image, mask)| dropout.apply(image, mask));
        active = (active * tensor(mask, (batch, len))?.to_device(device)?)?;
    }
    active.matmul(&hidden.t()?)
}

struct FrameEncoder {
    frames: Arc<dyn Frames>,
    sizes: Convolution,
    hidden: Tensor,
    trained: bool,
    precision: Precision,
    dropout: Option<Dropout>,
    /// `relu(conv(frames))` `[batch, channels * positions]`, without what is left out; kept for the gradients.
    active: OnceLock<Buffer>,
}

impl FrameEncoder {
    /// Images in a part of the batch.
    fn part(&self) -> usize {
        self.frames.batch().div_ceil(PARTS)
    }

    fn convolve(&self, kernel: &[f32], bias: &[f32]) -> Buffer {
        let (sizes, part) = (self.sizes, self.part());
        let mut active = Buffer::new(self.frames.batch() * sizes.coarse_len());
        active.par_chunks_mut(part * sizes.coarse_len()).enumerate().for_each(|(part_index, active)| {
            let (mut frame, mut fine) = (kernels::scratch(sizes.fine_len()), Fine::new(sizes));
            for (index, active) in active.chunks_exact_mut(sizes.coarse_len()).enumerate() {
                let image = part_index * part + index;
                self.frames.write(image, &mut frame);
                fine.set(&frame);
                sizes.convolve(&fine, kernel, active);
                activate(active, bias);
                if let Some(dropout) = self.dropout {
                    dropout.apply(image, active);
                }
            }
        });
        active
    }

    /// Gradients of the convolution's kernel and bias, given that of its activations.
    fn convolution_gradients(&self, grad_active: &[f32]) -> (Vec<f32>, Vec<f32>) {
        let (sizes, part) = (self.sizes, self.part());
        let active = self.active.get().map(|active| &**active).unwrap_or_default();
        let sums = grad_active
            .par_chunks(part * sizes.coarse_len())
            .zip(active.par_chunks(part * sizes.coarse_len()))
            .enumerate()
            .map(|(part_index, (grad, active))| {
                let (mut frame, mut fine) = (kernels::scratch(sizes.fine_len()), Fine::new(sizes));
                let (mut coarse, mut kernel) = (Coarse::new(sizes), KernelSums::new(sizes));
                let mut bias = vec![0.0; sizes.coarse_channels];
                let images =
                    grad.chunks_exact(sizes.coarse_len()).zip(active.chunks_exact(sizes.coarse_len()));
                for (index, (grad, active)) in images.enumerate() {
                    coarse.set_masked(grad, active);
                    self.frames.write(part_index * part + index, &mut frame);
                    fine.set(&frame);
                    sizes.add_kernel_gradient(&fine, &coarse, &mut kernel);
                    coarse.add_channel_sums(&mut bias);
                }
                (kernel.total(), bias)
            });
        let (kernel, bias): (Vec<_>, Vec<_>) = sums.collect::<Vec<_>>().into_iter().unzip();
        let mut kernel = kernels::sum_in_order(kernel, sizes.kernel_len());
        let mut bias = kernels::sum_in_order(bias, sizes.coarse_channels);
        if let Some(dropout) = self.dropout {
            // What was left out is zero like what the ReLU cut, and passes no gradient; the rest was raised.
            kernel.iter_mut().chain(&mut bias).for_each(|grad| *grad *= dropout.scale());
        }
        (kernel, bias)
    }
}

/// `relu(channel + bias)` for each channel, in place.
fn activate(channels: &mut [f32], bias: &[f32]) {
    let positions = channels.len() / bias.len();
    simd(
        #[inline(always)]
        || {
            for (channel, bias) in channels.chunks_exact_mut(positions).zip(bias) {
                for value in channel {
                    *value = (*value + bias).max(0.0);
                }
            }
        },
    );
}

impl CustomOp2 for FrameEncoder {
    fn name(&self) -> &'static str {
        "frame-encoder"
    }

    fn cpu_fwd(
        &self,
        kernel: &CpuStorage,
        kernel_layout: &Layout,
        bias: &CpuStorage,
        bias_layout: &Layout,
    ) -> Result<(CpuStorage, Shape)> {
        let active = self.convolve(slice(kernel, kernel_layout)?, slice(bias, bias_layout)?);
        let (batch, (outputs, inputs)) = (self.frames.batch(), self.hidden.dims2()?);
        let mut out = kernels::scratch(batch * outputs);
        with_values(&self.hidden, |hidden| {
            let (active, hidden) =
                (Matrix::plain(&active, batch, inputs), Matrix::transposed(hidden, outputs, inputs));
            product(active, hidden, &mut out, Into::Overwrite, self.precision, threads());
            Ok(())
        })?;
        self.active.get_or_init(|| active);
        Ok((CpuStorage::F32(out), (batch, outputs).into()))
    }

    fn bwd(
        &self,
        kernel: &Tensor,
        bias: &Tensor,
        _out: &Tensor,
        grad: &Tensor,
    ) -> Result<(Option<Tensor>, Option<Tensor>)> {
        let (batch, (outputs, inputs)) = (self.frames.batch(), self.hidden.dims2()?);
        let active = self.active.get().map(|active| &**active).unwrap_or_default();
        let mut grad_active = Buffer::new(batch * inputs);
        with_values(grad, |grad| {
            if self.trained {
                let mut grad_hidden = kernels::scratch(outputs * inputs);
                let (grad, active) =
                    (Matrix::transposed(grad, batch, outputs), Matrix::plain(active, batch, inputs));
                product(grad, active, &mut grad_hidden, Into::Overwrite, self.precision, threads());
                hand_over(&self.hidden, grad_hidden)?;
            }
            with_values(&self.hidden, |hidden| {
                let (grad, hidden) =
                    (Matrix::plain(grad, batch, outputs), Matrix::plain(hidden, outputs, inputs));
                product(grad, hidden, &mut grad_active, Into::Overwrite, self.precision, threads());
                Ok(())
            })
        })?;
        let (grad_kernel, grad_bias) = self.convolution_gradients(&grad_active);
        Ok((Some(tensor(grad_kernel, kernel.shape())?), Some(tensor(grad_bias, bias.shape())?)))
    }
}
