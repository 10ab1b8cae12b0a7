//! The decoder's last two layers, to frames: a fully connected layer, ReLU, transposed convolution and the mean
//! squared error, as one op.
//!
//! Predicted frames and their gradients exist one image at a time, in cache. Since a loss is a scalar, its
//! gradients are known up to a factor as soon as it is, and are computed in the forward pass, where they take the
//! place of the activations.

use super::{hand_over, is_trained, slice, tensor, threads, with_values};
use crate::dataset::frames::Frames;
use crate::learning::kernels::convolution::{Coarse, Convolution, Fine, KernelSums};
use crate::learning::kernels::product::{Into, Matrix, product};
use crate::learning::kernels::{self, Buffer, PARTS, add_to, simd};
use crate::spec::Precision;
use candle_core::{CpuStorage, CustomOp3, Layout, Result, Shape, Tensor};
use rayon::prelude::*;
use std::sync::{Arc, Mutex};

/// The parameters between the decoder's hidden layer and a frame.
pub struct FrameDecoder {
    /// `[channels * (side / 2)², hidden]`, a variable or detached.
    pub weight: Tensor,
    /// `[channels * (side / 2)²]`, a variable or detached.
    pub bias: Tensor,
    /// Of the transposed convolution (stride 2, padding 1): `[channels, frame channels, 4, 4]`.
    pub kernel: Tensor,
    /// `[frame channels]`.
    pub kernel_bias: Tensor,
    /// Of the fully connected layer's products.
    pub precision: Precision,
}

impl FrameDecoder {
    fn sizes(&self, side: usize) -> Result<Convolution> {
        let (coarse_channels, fine_channels, ..) = self.kernel.dims4()?;
        Ok(Convolution { fine_channels, coarse_channels, side })
    }

    /// `hidden weightᵀ` `[batch, channels * (side / 2)²]`, without the bias.
    fn coarse(&self, hidden: &[f32]) -> Result<Buffer> {
        let (outputs, inputs) = self.weight.dims2()?;
        let batch = hidden.len() / inputs;
        let mut coarse = Buffer::new(batch * outputs);
        with_values(&self.weight, |weight| {
            let (hidden, weight) =
                (Matrix::plain(hidden, batch, inputs), Matrix::transposed(weight, outputs, inputs));
            product(hidden, weight, &mut coarse, Into::Overwrite, self.precision, threads());
            Ok(())
        })?;
        Ok(coarse)
    }

    /// The same as [`frame_decoder`] from candle's operations.
    fn compose(&self, hidden: &Tensor, side: usize) -> Result<Tensor> {
        let (channels, frame_channels, ..) = self.kernel.dims4()?;
        hidden
            .matmul(&self.weight.t()?)?
            .broadcast_add(&self.bias)?
            .relu()?
            .reshape((hidden.dim(0)?, channels, side / 2, side / 2))?
            .conv_transpose2d(&self.kernel, 1, 0, 2, 1)?
            .broadcast_add(&self.kernel_bias.reshape((1, frame_channels, 1, 1))?)
    }
}

/// Mean squared error between the frames that `decoder` makes of `hidden` `[batch, hidden]` and `target`, over all
/// values of the batch; a scalar.
pub fn frame_loss(hidden: &Tensor, decoder: FrameDecoder, target: Arc<dyn Frames>) -> Result<Tensor> {
    if !hidden.device().is_cpu() {
        let predicted = decoder.compose(hidden, target.side())?;
        return (predicted - target.tensor(hidden.device())?)?.sqr()?.mean_all();
    }
    let trained = is_trained(&decoder.weight)? | is_trained(&decoder.bias)?;
    let arguments = [hidden, &decoder.kernel, &decoder.kernel_bias];
    let trained = trained || arguments.iter().any(|tensor| tensor.track_op());
    let sizes = decoder.sizes(target.side())?;
    let (kernel, kernel_bias) = (decoder.kernel.clone(), decoder.kernel_bias.clone());
    let op = FrameLoss { decoder, target, sizes, trained, gradients: Mutex::new(None) };
    hidden.contiguous()?.apply_op3(&kernel, &kernel_bias, op)
}

/// The frames that `decoder` makes of `hidden` `[batch, hidden]`: `[batch, frame channels, side, side]`, without
/// gradients.
pub fn frame_decoder(hidden: &Tensor, decoder: &FrameDecoder, side: usize) -> Result<Tensor> {
    if !hidden.device().is_cpu() {
        return decoder.compose(hidden, side);
    }
    let sizes = decoder.sizes(side)?;
    let coarse = with_values(hidden, |hidden| decoder.coarse(hidden))?;
    let batch = hidden.dim(0)?;
    let mut frames = kernels::scratch(batch * sizes.fine_len());
    with_values(&decoder.bias, |bias| {
        with_values(&decoder.kernel, |kernel| {
            with_values(&decoder.kernel_bias, |kernel_bias| {
                let images =
                    frames.par_chunks_mut(sizes.fine_len()).zip(coarse.par_chunks(sizes.coarse_len()));
                images.for_each_init(
                    || Coarse::new(sizes),
                    |active, (frame, coarse)| {
                        active.set_active(coarse, bias);
                        sizes.spread(active, kernel, kernel_bias, frame);
                    },
                );
                Ok(())
            })
        })
    })?;
    tensor(frames, (batch, sizes.fine_channels, side, side))
}

struct FrameLoss {
    decoder: FrameDecoder,
    target: Arc<dyn Frames>,
    sizes: Convolution,
    trained: bool,
    gradients: Mutex<Option<Gradients>>,
}

/// Of the parameters, and of the hidden layer's output.
struct Gradients {
    hidden: Vec<f32>,
    weight: Vec<f32>,
    bias: Vec<f32>,
    kernel: Vec<f32>,
    kernel_bias: Vec<f32>,
}

/// What one part of the batch adds to the sums.
struct Part {
    squared_error: f64,
    bias: Vec<f32>,
    kernel: Vec<f32>,
    kernel_bias: Vec<f32>,
}

impl FrameLoss {
    /// One part of the batch, from image `first` on. Replaces `coarse`, the activations without bias and ReLU, by
    /// the gradient with regard to them where gradients are wanted.
    fn part(
        &self,
        first: usize,
        coarse: &mut [f32],
        bias: &[f32],
        kernel: &[f32],
        kernel_bias: &[f32],
    ) -> Part {
        let sizes = self.sizes;
        let scale = 2.0 / (self.target.batch() * sizes.fine_len()) as f32;
        let (mut active, mut fine, mut sums) = (Coarse::new(sizes), Fine::new(sizes), KernelSums::new(sizes));
        let (mut frame, mut target) =
            (kernels::scratch(sizes.fine_len()), kernels::scratch(sizes.fine_len()));
        let mut part = Part {
            squared_error: 0.0,
            bias: vec![0.0; bias.len()],
            kernel: Vec::new(),
            kernel_bias: vec![0.0; kernel_bias.len()],
        };
        for (index, coarse) in coarse.chunks_exact_mut(sizes.coarse_len()).enumerate() {
            active.set_active(coarse, bias);
            sizes.spread(&active, kernel, kernel_bias, &mut frame);
            self.target.write(first + index, &mut target);
            part.squared_error += errors(&mut frame, &target, scale);
            if self.trained {
                fine.set(&frame);
                sizes.convolve(&fine, kernel, coarse);
                active.mask(coarse);
                add_to(&mut part.bias, coarse);
                sizes.add_kernel_gradient(&fine, &active, &mut sums);
                let channels = frame.chunks_exact(sizes.side * sizes.side);
                for (sum, channel) in part.kernel_bias.iter_mut().zip(channels) {
                    *sum += kernels::sum(channel);
                }
            }
        }
        part.kernel = sums.total();
        part
    }

    /// The gradients, given that of the activations before the ReLU.
    fn gradients(&self, hidden: &[f32], grad_coarse: &[f32], parts: Vec<Part>) -> Result<Gradients> {
        let (outputs, inputs) = self.decoder.weight.dims2()?;
        let batch = self.target.batch();
        let mut grad_hidden = kernels::scratch(batch * inputs);
        with_values(&self.decoder.weight, |weight| {
            let (grad, weight) =
                (Matrix::plain(grad_coarse, batch, outputs), Matrix::plain(weight, outputs, inputs));
            product(grad, weight, &mut grad_hidden, Into::Overwrite, self.decoder.precision, threads());
            Ok(())
        })?;
        let mut grad_weight = kernels::scratch(outputs * inputs);
        let (grad, hidden) =
            (Matrix::transposed(grad_coarse, batch, outputs), Matrix::plain(hidden, batch, inputs));
        product(grad, hidden, &mut grad_weight, Into::Overwrite, self.decoder.precision, threads());
        let (mut bias, mut kernel, mut kernel_bias) = (Vec::new(), Vec::new(), Vec::new());
        for part in parts {
            bias.push(part.bias);
            kernel.push(part.kernel);
            kernel_bias.push(part.kernel_bias);
        }
        Ok(Gradients {
            hidden: grad_hidden,
            weight: grad_weight,
            bias: kernels::sum_in_order(bias, outputs),
            kernel: kernels::sum_in_order(kernel, self.sizes.kernel_len()),
            kernel_bias: kernels::sum_in_order(kernel_bias, self.sizes.fine_channels),
        })
    }
}

/// `values = scale * (values - target)`; the sum of the squared differences.
fn errors(values: &mut [f32], target: &[f32], scale: f32) -> f64 {
    const LANES: usize = 16;
    const RUN: usize = 64 * LANES;
    simd(
        #[inline(always)]
        || {
            let mut sum = 0.0;
            for (values, target) in values.chunks_mut(RUN).zip(target.chunks(RUN)) {
                let mut squares = [0.0f32; LANES];
                for (values, target) in values.chunks_mut(LANES).zip(target.chunks(LANES)) {
                    for ((value, target), square) in values.iter_mut().zip(target).zip(&mut squares) {
                        let error = *value - target;
                        *square += error * error;
                        *value = error * scale;
                    }
                }
                sum += squares.iter().map(|square| f64::from(*square)).sum::<f64>();
            }
            sum
        },
    )
}

impl CustomOp3 for FrameLoss {
    fn name(&self) -> &'static str {
        "frame-loss"
    }

    fn cpu_fwd(
        &self,
        hidden: &CpuStorage,
        hidden_layout: &Layout,
        kernel: &CpuStorage,
        kernel_layout: &Layout,
        kernel_bias: &CpuStorage,
        kernel_bias_layout: &Layout,
    ) -> Result<(CpuStorage, Shape)> {
        let hidden = slice(hidden, hidden_layout)?;
        let (kernel, kernel_bias) = (slice(kernel, kernel_layout)?, slice(kernel_bias, kernel_bias_layout)?);
        let mut coarse = self.decoder.coarse(hidden)?;
        let images = self.target.batch().div_ceil(PARTS);
        let parts: Vec<Part> = with_values(&self.decoder.bias, |bias| {
            let parts = coarse.par_chunks_mut(images * self.sizes.coarse_len()).enumerate();
            Ok(parts
                .map(|(index, coarse)| self.part(index * images, coarse, bias, kernel, kernel_bias))
                .collect())
        })?;
        let squared_error: f64 = parts.iter().map(|part| part.squared_error).sum();
        let mean = squared_error / (self.target.batch() * self.sizes.fine_len()) as f64;
        if self.trained {
            let gradients = self.gradients(hidden, &coarse, parts)?;
            *self.gradients.lock().unwrap_or_else(|poisoned| poisoned.into_inner()) = Some(gradients);
        }
        Ok((CpuStorage::F32(vec![mean as f32]), ().into()))
    }

    fn bwd(
        &self,
        hidden: &Tensor,
        kernel: &Tensor,
        kernel_bias: &Tensor,
        _loss: &Tensor,
        grad: &Tensor,
    ) -> Result<(Option<Tensor>, Option<Tensor>, Option<Tensor>)> {
        let gradients = self.gradients.lock().unwrap_or_else(|poisoned| poisoned.into_inner()).take();
        let Some(gradients) = gradients else {
            candle_core::bail!("the frame loss's gradients were already taken; run its forward pass again")
        };
        let factor = grad.to_scalar::<f32>()?;
        let scaled = |mut values: Vec<f32>| {
            if factor != 1.0 {
                values.par_iter_mut().for_each(|value| *value *= factor);
            }
            values
        };
        for (weight, gradient) in
            [(&self.decoder.weight, gradients.weight), (&self.decoder.bias, gradients.bias)]
        {
            if is_trained(weight)? {
                hand_over(weight, scaled(gradient))?;
            }
        }
        Ok((
            Some(tensor(scaled(gradients.hidden), hidden.shape())?),
            Some(tensor(scaled(gradients.kernel), kernel.shape())?),
            Some(tensor(scaled(gradients.kernel_bias), kernel_bias.shape())?),
        ))
    }
}
