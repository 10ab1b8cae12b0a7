//! The decoder's last step to frames: ReLU, transposed convolution and the mean squared error, as one op.
//!
//! Predicted frames and their gradients exist one image at a time, in cache. Since a loss is a scalar, its
//! gradients are known up to a factor as soon as it is, and are computed in the forward pass.

use super::{slice, tensor};
use crate::dataset::frames::Frames;
use crate::learning::kernels::{self, Into, Matrix, PARTS, Patches, product};
use candle_core::{CpuStorage, CustomOp3, Layout, Result, Shape, Tensor};
use rayon::prelude::*;
use std::sync::{Arc, Mutex};

/// Mean squared error between `deconv(relu(coarse))` and `target`, over all values of the batch; a scalar.
///
/// `coarse` is `[batch, channels * (side / 2)²]`; `kernel` `[channels, frame channels, 4, 4]` and `bias`
/// `[frame channels]` make the transposed convolution (stride 2, padding 1).
pub fn frame_loss(
    coarse: &Tensor,
    kernel: &Tensor,
    bias: &Tensor,
    target: Arc<dyn Frames>,
) -> Result<Tensor> {
    if coarse.device().is_cpu() {
        let patches = patches_of(kernel, target.side())?;
        let trained = [coarse, kernel, bias].iter().any(|tensor| tensor.track_op());
        return coarse.apply_op3(
            kernel,
            bias,
            FrameLoss { target, patches, trained, gradients: Mutex::new(None) },
        );
    }
    let predicted = compose(coarse, kernel, bias, target.side())?;
    (predicted - target.tensor(coarse.device())?)?.sqr()?.mean_all()
}

/// `deconv(relu(coarse))`, `[batch, frame channels, side, side]`, without gradients.
pub fn frame_decoder(coarse: &Tensor, kernel: &Tensor, bias: &Tensor, side: usize) -> Result<Tensor> {
    if coarse.device().is_cpu() {
        let patches = patches_of(kernel, side)?;
        return coarse.apply_op3_no_bwd(kernel, bias, &FrameDecoder { patches });
    }
    compose(coarse, kernel, bias, side)
}

fn compose(coarse: &Tensor, kernel: &Tensor, bias: &Tensor, side: usize) -> Result<Tensor> {
    let (channels, frame_channels, ..) = kernel.dims4()?;
    coarse
        .relu()?
        .reshape((coarse.dim(0)?, channels, side / 2, side / 2))?
        .conv_transpose2d(kernel, 1, 0, 2, 1)?
        .broadcast_add(&bias.reshape((1, frame_channels, 1, 1))?)
}

fn patches_of(kernel: &Tensor, side: usize) -> Result<Patches> {
    let (coarse_channels, fine_channels, ..) = kernel.dims4()?;
    Ok(Patches { fine_channels, coarse_channels, side })
}

/// `relu(coarse)`, its patches' products and the image that they add up to: one image's buffers.
struct Image {
    active: Vec<f32>,
    cut: Vec<f32>,
    frame: Vec<f32>,
}

impl Image {
    fn new(patches: Patches) -> Self {
        Self {
            active: kernels::scratch(patches.coarse_len()),
            cut: kernels::scratch(patches.patch_len() * patches.positions()),
            frame: kernels::scratch(patches.fine_len()),
        }
    }

    /// Decodes one image into `self.frame`.
    fn decode(&mut self, patches: Patches, coarse: &[f32], kernel: &[f32], bias: &[f32]) {
        for (active, coarse) in self.active.iter_mut().zip(coarse) {
            *active = coarse.max(0.0);
        }
        product(
            Matrix::transposed(kernel, patches.coarse_channels, patches.patch_len()),
            Matrix::plain(&self.active, patches.coarse_channels, patches.positions()),
            &mut self.cut,
            Into::Overwrite,
            1,
        );
        patches.paste(&self.cut, bias, &mut self.frame);
    }
}

struct FrameDecoder {
    patches: Patches,
}

impl CustomOp3 for FrameDecoder {
    fn name(&self) -> &'static str {
        "frame-decoder"
    }

    fn cpu_fwd(
        &self,
        coarse: &CpuStorage,
        coarse_layout: &Layout,
        kernel: &CpuStorage,
        kernel_layout: &Layout,
        bias: &CpuStorage,
        bias_layout: &Layout,
    ) -> Result<(CpuStorage, Shape)> {
        let patches = self.patches;
        let (coarse, kernel, bias) =
            (slice(coarse, coarse_layout)?, slice(kernel, kernel_layout)?, slice(bias, bias_layout)?);
        let batch = coarse.len() / patches.coarse_len();
        let mut frames = kernels::scratch(batch * patches.fine_len());
        frames.par_chunks_mut(patches.fine_len()).zip(coarse.par_chunks(patches.coarse_len())).for_each_init(
            || Image::new(patches),
            |image, (frame, coarse)| {
                image.decode(patches, coarse, kernel, bias);
                frame.copy_from_slice(&image.frame);
            },
        );
        let shape = (batch, patches.fine_channels, patches.side, patches.side);
        Ok((CpuStorage::F32(frames), shape.into()))
    }
}

struct FrameLoss {
    target: Arc<dyn Frames>,
    patches: Patches,
    trained: bool,
    gradients: Mutex<Option<Gradients>>,
}

struct Gradients {
    coarse: Vec<f32>,
    kernel: Vec<f32>,
    bias: Vec<f32>,
}

/// What one part of the batch adds to the sums.
struct Part {
    squared_error: f64,
    kernel: Vec<f32>,
    bias: Vec<f32>,
}

impl FrameLoss {
    /// One part of the batch, from image `first` on; writes the gradient of `coarse` into `grad_coarse`.
    fn part(
        &self,
        first: usize,
        coarse: &[f32],
        grad_coarse: &mut [f32],
        kernel: &[f32],
        bias: &[f32],
    ) -> Part {
        let patches = self.patches;
        let coarse_len = patches.coarse_len();
        let scale = 2.0 / (self.target.batch() * patches.fine_len()) as f32;
        let mut image = Image::new(patches);
        let mut target = kernels::scratch(patches.fine_len());
        let mut part =
            Part { squared_error: 0.0, kernel: vec![0.0; kernel.len()], bias: vec![0.0; bias.len()] };
        for (index, coarse) in coarse.chunks_exact(coarse_len).enumerate() {
            image.decode(patches, coarse, kernel, bias);
            self.target.write(first + index, &mut target);
            part.squared_error += subtract(&mut image.frame, &target);
            if self.trained {
                image.frame.iter_mut().for_each(|error| *error *= scale);
                part.gradients(
                    patches,
                    &mut image,
                    &mut grad_coarse[index * coarse_len..][..coarse_len],
                    kernel,
                );
            }
        }
        part
    }
}

impl Part {
    /// Adds one image's gradients, given that of its frame in `image.frame`.
    fn gradients(&mut self, patches: Patches, image: &mut Image, grad_coarse: &mut [f32], kernel: &[f32]) {
        let (coarse, patch, positions) = (patches.coarse_channels, patches.patch_len(), patches.positions());
        patches.cut(&image.frame, &mut image.cut);
        let cut = Matrix::plain(&image.cut, patch, positions);
        product(Matrix::plain(kernel, coarse, patch), cut, grad_coarse, Into::Overwrite, 1);
        kernels::mask(grad_coarse, &image.active);
        product(
            Matrix::plain(&image.active, coarse, positions),
            Matrix::transposed(&image.cut, patch, positions),
            &mut self.kernel,
            Into::Add,
            1,
        );
        let plane = patches.side * patches.side;
        for (sum, plane) in self.bias.iter_mut().zip(image.frame.chunks_exact(plane)) {
            *sum += plane.iter().sum::<f32>();
        }
    }
}

/// `values -= target`; the sum of the squared differences.
fn subtract(values: &mut [f32], target: &[f32]) -> f64 {
    const LANES: usize = 1024;
    let mut sum = 0.0;
    for (values, target) in values.chunks_mut(LANES).zip(target.chunks(LANES)) {
        let mut squares = [0.0f32; 16];
        for (values, target) in values.chunks_mut(16).zip(target.chunks(16)) {
            for ((value, target), square) in values.iter_mut().zip(target).zip(&mut squares) {
                *value -= target;
                *square += *value * *value;
            }
        }
        sum += squares.iter().map(|square| f64::from(*square)).sum::<f64>();
    }
    sum
}

impl CustomOp3 for FrameLoss {
    fn name(&self) -> &'static str {
        "frame-loss"
    }

    fn cpu_fwd(
        &self,
        coarse: &CpuStorage,
        coarse_layout: &Layout,
        kernel: &CpuStorage,
        kernel_layout: &Layout,
        bias: &CpuStorage,
        bias_layout: &Layout,
    ) -> Result<(CpuStorage, Shape)> {
        let (coarse, kernel, bias) =
            (slice(coarse, coarse_layout)?, slice(kernel, kernel_layout)?, slice(bias, bias_layout)?);
        let part = self.target.batch().div_ceil(PARTS);
        let part_len = part * self.patches.coarse_len();
        let mut grad_coarse = kernels::scratch(coarse.len());
        let parts: Vec<Part> = coarse
            .par_chunks(part_len)
            .zip(grad_coarse.par_chunks_mut(part_len))
            .enumerate()
            .map(|(index, (coarse, grad))| self.part(index * part, coarse, grad, kernel, bias))
            .collect();
        let squared_error: f64 = parts.iter().map(|part| part.squared_error).sum();
        let mean = squared_error / (self.target.batch() * self.patches.fine_len()) as f64;
        if self.trained {
            let (kernels, biases) = parts.into_iter().map(|part| (part.kernel, part.bias)).unzip();
            let gradients = Gradients {
                coarse: grad_coarse,
                kernel: kernels::sum_in_order(kernels, kernel.len()),
                bias: kernels::sum_in_order(biases, bias.len()),
            };
            *self.gradients.lock().unwrap_or_else(|poisoned| poisoned.into_inner()) = Some(gradients);
        }
        Ok((CpuStorage::F32(vec![mean as f32]), ().into()))
    }

    fn bwd(
        &self,
        coarse: &Tensor,
        kernel: &Tensor,
        bias: &Tensor,
        _loss: &Tensor,
        grad: &Tensor,
    ) -> Result<(Option<Tensor>, Option<Tensor>, Option<Tensor>)> {
        let gradients = self.gradients.lock().unwrap_or_else(|poisoned| poisoned.into_inner()).take();
        let Some(gradients) = gradients else {
            candle_core::bail!("the frame loss's gradients were already taken; run its forward pass again")
        };
        let factor = grad.to_scalar::<f32>()?;
        let scaled = |mut values: Vec<f32>, shape: &Shape| {
            if factor != 1.0 {
                values.par_iter_mut().for_each(|value| *value *= factor);
            }
            tensor(values, shape.clone())
        };
        Ok((
            Some(scaled(gradients.coarse, coarse.shape())?),
            Some(scaled(gradients.kernel, kernel.shape())?),
            Some(scaled(gradients.bias, bias.shape())?),
        ))
    }
}
