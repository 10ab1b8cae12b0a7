//! The decoder's path to frames, and their mean squared error.

use super::convolution::{Places, Then, convolve, spread};
use super::{Gpu, Matrix, blocks, each, launch, not_on_cpu, slice, with_values, write_column_sums};
use crate::FrameDecoder;
use crate::frames::Frames;
use crate::stack::Side;
use candle_core::cuda::cudarc::driver::{CudaSlice, CudaView};
use candle_core::{CudaStorage, CustomOp3, Layout, Result, Shape, Tensor, bail};
use std::sync::{Arc, Mutex};

/// The most blocks that sum squared errors.
const BLOCKS: usize = 1024;

/// The same as [`crate::frame_loss`], on a GPU.
pub fn frame_loss(hidden: &Tensor, decoder: FrameDecoder, target: Arc<dyn Frames>) -> Result<Tensor> {
    let (weight, packed) = (decoder.weight.contiguous()?, decoder.packed.clone());
    let target = target.tensor(hidden.device())?;
    let trained = [hidden, &weight, &packed].iter().any(|tensor| tensor.track_op());
    let op = FrameLoss { decoder, target, trained, levels: Mutex::new(Vec::new()) };
    hidden.contiguous()?.apply_op3(&weight, &packed, op)
}

/// The same as [`crate::frame_decoder`], on a GPU.
pub fn frame_decoder(hidden: &Tensor, decoder: &FrameDecoder) -> Result<Tensor> {
    let (gpu, batch) = (Gpu::of(hidden)?, hidden.dim(0)?);
    let mut levels = with_values(hidden, |hidden| {
        with_values(&decoder.weight, |weight| {
            with_values(&decoder.packed, |packed| levels(&gpu, decoder, [hidden, weight, packed], batch))
        })
    })?;
    let first = &decoder.stack.layers()[0];
    let [rows, columns] = first.size;
    Ok(gpu.tensor(levels.remove(0), (batch, first.fine_channels, rows, columns)))
}

/// Returns the images at all levels: the frames, those between each two convolutions, and the output of the fully
/// connected layer.
fn levels(
    gpu: &Gpu,
    decoder: &FrameDecoder,
    [hidden, weight, packed]: [&CudaView<f32>; 3],
    batch: usize,
) -> Result<Vec<CudaSlice<f32>>> {
    let (outputs, inputs) = decoder.weight.dims2()?;
    let (stack, places) = (&decoder.stack, Places::of(&decoder.stack, Side::Decoder));
    let mut coarse = gpu.scratch(batch * outputs)?;
    let (hidden, weight) =
        (Matrix::plain(hidden, batch, inputs), Matrix::transposed(weight, outputs, inputs));
    gpu.product(hidden, weight, &mut coarse, false, decoder.arithmetic)?;
    let (len, bias) = (batch * outputs, packed.slice(places.end()..));
    let columns = outputs as i32;
    launch!(gpu, VECTORS, "add_bias", each(len), &mut coarse, &bias, &(len as i32), &columns, &1_i32);
    let mut levels = vec![coarse];
    for (index, layer) in stack.layers().iter().enumerate().rev() {
        let [kernel, bias] = places.split(packed, index);
        let then = Then::bias(gpu, &bias, index > 0);
        levels.insert(0, spread(gpu, layer, batch, &levels[0].as_view(), &kernel, then)?);
    }
    Ok(levels)
}

struct FrameLoss {
    decoder: FrameDecoder,
    /// `[batch, channels, rows, columns]`
    target: Tensor,
    /// Whether any argument needs a gradient.
    trained: bool,
    /// Images at all levels, kept for the backward pass, which takes them. The frames are replaced by their gradients,
    /// for a loss whose own gradient is 1.
    levels: Mutex<Vec<CudaSlice<f32>>>,
}

impl CustomOp3 for FrameLoss {
    fn name(&self) -> &'static str {
        "frame-loss"
    }

    not_on_cpu!(CpuStorage, CpuStorage, CpuStorage);

    fn cuda_fwd(
        &self,
        hidden: &CudaStorage,
        hidden_layout: &Layout,
        weight: &CudaStorage,
        weight_layout: &Layout,
        packed: &CudaStorage,
        packed_layout: &Layout,
    ) -> Result<(CudaStorage, Shape)> {
        let (gpu, batch) = (Gpu::with(hidden), self.target.dims()[0]);
        let (hidden, weight) = (slice(hidden, hidden_layout)?, slice(weight, weight_layout)?);
        let packed = slice(packed, packed_layout)?;
        let mut levels = levels(&gpu, &self.decoder, [&hidden, &weight, &packed], batch)?;
        let len = levels[0].len();
        let count = len.div_ceil(4 * 256).clamp(1, BLOCKS);
        // SAFETY: each block writes its sum.
        let mut sums = unsafe { gpu.0.alloc::<f64>(count) }?;
        let mut loss = gpu.scratch(1)?;
        let (scale, long) = (2.0 / len as f32, len as i64);
        with_values(&self.target, |target| {
            let frames = &mut levels[0];
            launch!(gpu, FRAMES, "errors", blocks(count, 256), frames, target, &mut sums, &long, &scale);
            Ok(())
        })?;
        launch!(gpu, FRAMES, "mean_of_sums", blocks(1, 256), &sums, &mut loss, &(count as i32), &long);
        if self.trained {
            *self.levels.lock().unwrap_or_else(|poisoned| poisoned.into_inner()) = levels;
        }
        Ok(gpu.storage(loss, ()))
    }

    fn bwd(
        &self,
        hidden: &Tensor,
        weight: &Tensor,
        packed: &Tensor,
        _loss: &Tensor,
        grad: &Tensor,
    ) -> Result<(Option<Tensor>, Option<Tensor>, Option<Tensor>)> {
        let (gpu, batch) = (Gpu::of(hidden)?, hidden.dim(0)?);
        let levels =
            std::mem::take(&mut *self.levels.lock().unwrap_or_else(|poisoned| poisoned.into_inner()));
        let (stack, arithmetic) = (&self.decoder.stack, self.decoder.arithmetic);
        let (places, (outputs, inputs)) = (Places::of(stack, Side::Decoder), weight.dims2()?);
        let mut levels = levels.into_iter();
        let Some(mut fine) = levels.next() else {
            bail!("the frame loss's gradients were already taken; run its forward pass again")
        };
        let mut of_packed = gpu.scratch(packed.elem_count())?;
        with_values(packed, |packed| {
            for ((index, layer), coarse) in stack.layers().iter().enumerate().zip(levels) {
                let (grads, coarse) = (fine.as_view(), coarse.as_view());
                places.gradients(&gpu, (index, layer), [&grads, &coarse, &grads], batch, &mut of_packed)?;
                let [kernel, _] = places.split(packed, index);
                fine = convolve(&gpu, layer, batch, &grads, &kernel, Then::mask(&gpu, &coarse))?;
            }
            write_column_sums(&gpu, &fine.as_view(), &mut of_packed.slice_mut(places.end()..))
        })?;
        let (mut of_hidden, mut of_weight) = (gpu.scratch(batch * inputs)?, gpu.scratch(outputs * inputs)?);
        let grads = fine.as_view();
        with_values(weight, |weight| {
            let (grads, weight) =
                (Matrix::plain(&grads, batch, outputs), Matrix::plain(weight, outputs, inputs));
            gpu.product(grads, weight, &mut of_hidden, false, arithmetic)
        })?;
        with_values(hidden, |hidden| {
            let (grads, hidden) =
                (Matrix::transposed(&grads, batch, outputs), Matrix::plain(hidden, batch, inputs));
            gpu.product(grads, hidden, &mut of_weight, false, arithmetic)
        })?;
        let scaled = |values: CudaSlice<f32>, like: &Tensor| {
            gpu.tensor(values, like.shape()).broadcast_mul(grad).map(Some)
        };
        Ok((scaled(of_hidden, hidden)?, scaled(of_weight, weight)?, scaled(of_packed, packed)?))
    }
}
