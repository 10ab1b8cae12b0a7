//! The encoder's path for frames.

use super::convolution::{Places, Then, convolve, spread};
use super::{Gpu, Matrix, each, launch, not_on_cpu, slice, with_values};
use crate::frames::Frames;
use crate::stack::Side;
use crate::{Arithmetic, Dropout, Stack, Values, input};
use candle_core::cuda::cudarc::driver::CudaSlice;
use candle_core::{CudaStorage, CustomOp2, Layout, Result, Shape, Tensor, bail};
use std::sync::{Arc, OnceLock};

/// The same as [`crate::frame_encoder`], on a GPU.
pub fn frame_encoder(
    frames: Arc<dyn Frames>,
    stack: &Stack,
    packed: &Tensor,
    weight: &Tensor,
    arithmetic: Arithmetic,
    dropout: Option<Dropout>,
) -> Result<Tensor> {
    let device = packed.device();
    let dropout = dropout
        .map(|dropout| Ok::<_, candle_core::Error>((dropout, input(Values::U32(dropout.key()), 8, device)?)))
        .transpose()?;
    let op = FrameEncoder {
        frames: frames.tensor(device)?,
        stack: stack.clone(),
        arithmetic,
        dropout,
        levels: OnceLock::new(),
    };
    packed.apply_op2(&weight.contiguous()?, op)
}

struct FrameEncoder {
    /// `[batch, channels, rows, columns]`
    frames: Tensor,
    stack: Stack,
    arithmetic: Arithmetic,
    /// The dropout, with its key on the GPU.
    dropout: Option<(Dropout, Tensor)>,
    /// Images after each convolution, the last ones after dropout, kept for the backward pass.
    levels: OnceLock<Vec<CudaSlice<f32>>>,
}

impl FrameEncoder {
    fn batch(&self) -> usize {
        self.frames.dims()[0]
    }

    /// Applies the dropout to the images after the last convolution.
    fn drop(&self, gpu: &Gpu, active: &mut CudaSlice<f32>) -> Result<()> {
        let Some((dropout, key)) = &self.dropout else { return Ok(()) };
        let (batch, len) = (self.batch(), self.stack.coarse_len());
        let blocks = len.div_ceil(32);
        let (left_out, scale) = (i32::from(dropout.left_out()), dropout.scale());
        let config = each(batch * blocks);
        let (batch, len, blocks) = (batch as i32, len as i32, blocks as i32);
        let (storage, _) = key.storage_and_layout();
        let candle_core::Storage::Cuda(storage) = &*storage else { bail!("the key is on another device") };
        let key = storage.as_cuda_slice::<u32>()?;
        launch!(gpu, FRAMES, "drop", config, active, key, &left_out, &scale, &batch, &len, &blocks);
        Ok(())
    }
}

impl CustomOp2 for FrameEncoder {
    fn name(&self) -> &'static str {
        "frame-encoder"
    }

    not_on_cpu!(CpuStorage, CpuStorage);

    fn cuda_fwd(
        &self,
        packed: &CudaStorage,
        packed_layout: &Layout,
        weight: &CudaStorage,
        weight_layout: &Layout,
    ) -> Result<(CudaStorage, Shape)> {
        let (gpu, (outputs, inputs)) = (Gpu::with(packed), weight_layout.shape().dims2()?);
        let (packed, weight) = (slice(packed, packed_layout)?, slice(weight, weight_layout)?);
        let (batch, places) = (self.batch(), Places::of(&self.stack, Side::Encoder));
        let mut levels: Vec<CudaSlice<f32>> = Vec::new();
        for (index, layer) in self.stack.layers().iter().enumerate() {
            let [kernel, bias] = places.split(&packed, index);
            let then = Then::bias(&gpu, &bias, true);
            let level = match levels.last() {
                Some(fine) => convolve(&gpu, layer, batch, &fine.as_view(), &kernel, then),
                None => with_values(&self.frames, |fine| convolve(&gpu, layer, batch, fine, &kernel, then)),
            };
            levels.push(level?);
        }
        let Some(active) = levels.last_mut() else { bail!("there are no convolutions") };
        self.drop(&gpu, active)?;
        let mut out = gpu.scratch(batch * outputs)?;
        let active = active.as_view();
        let (active, weight) =
            (Matrix::plain(&active, batch, inputs), Matrix::transposed(&weight, outputs, inputs));
        gpu.product(active, weight, &mut out, false, self.arithmetic)?;
        self.levels.get_or_init(|| levels);
        Ok(gpu.storage(out, (batch, outputs)))
    }

    fn bwd(
        &self,
        packed: &Tensor,
        weight: &Tensor,
        _out: &Tensor,
        grad: &Tensor,
    ) -> Result<(Option<Tensor>, Option<Tensor>)> {
        let (gpu, batch, (outputs, inputs)) = (Gpu::of(packed)?, self.batch(), weight.dims2()?);
        let levels = self.levels.get().map(Vec::as_slice).unwrap_or_default();
        let Some(active) = levels.last() else { bail!("the encoder has no activations to go back from") };
        let active = active.as_view();
        let mut of_active = gpu.scratch(batch * inputs)?;
        let mut of_weight = gpu.scratch(outputs * inputs)?;
        with_values(grad, |grad| {
            let (plain, transposed) =
                (Matrix::plain(grad, batch, outputs), Matrix::transposed(grad, batch, outputs));
            let active = Matrix::plain(&active, batch, inputs);
            gpu.product(transposed, active, &mut of_weight, false, self.arithmetic)?;
            with_values(weight, |weight| {
                let weight = Matrix::plain(weight, outputs, inputs);
                gpu.product(plain, weight, &mut of_active, false, self.arithmetic)
            })
        })?;
        // A value that dropout set to zero passes no gradient, like one that the ReLU cut.
        let factor = self.dropout.as_ref().map_or(1.0, |(dropout, _)| dropout.scale());
        let len = batch * inputs;
        let mut coarse = gpu.scratch(len)?;
        launch!(gpu, VECTORS, "masked", each(len), &of_active, &active, &mut coarse, &factor, &(len as i32));
        let mut of_packed = gpu.scratch(packed.elem_count())?;
        let places = Places::of(&self.stack, Side::Encoder);
        with_values(packed, |packed| {
            for (index, layer) in self.stack.layers().iter().enumerate().rev() {
                let grads = coarse.as_view();
                let Some(fine) = index.checked_sub(1).map(|index| &levels[index]) else {
                    return with_values(&self.frames, |frames| {
                        let given = [frames, &grads, &grads];
                        places.gradients(&gpu, (index, layer), given, batch, &mut of_packed)
                    });
                };
                let fine = fine.as_view();
                places.gradients(&gpu, (index, layer), [&fine, &grads, &grads], batch, &mut of_packed)?;
                let [kernel, _] = places.split(packed, index);
                coarse = spread(&gpu, layer, batch, &grads, &kernel, Then::mask(&gpu, &fine))?;
            }
            Ok(())
        })?;
        Ok((Some(gpu.tensor(of_packed, packed.shape())), Some(gpu.tensor(of_weight, (outputs, inputs)))))
    }
}
