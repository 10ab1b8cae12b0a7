//! The mean losses of several quantities whose columns lie side by side.

use super::{Gpu, each, launch, not_on_cpu, slice, with_values};
use crate::Quantity;
use candle_core::cuda::cudarc::driver::{DeviceRepr, LaunchConfig};
use candle_core::{CudaStorage, CustomOp1, Layout, Result, Shape, Tensor, bail};
use harness_spec::Loss;

/// The most quantities.
const QUANTITIES: usize = 32;

/// The same as [`crate::vector_losses`], on a GPU.
pub fn vector_losses(
    predicted: &Tensor,
    target: &Tensor,
    quantities: &[Quantity],
    parts: usize,
) -> Result<Tensor> {
    if quantities.len() > QUANTITIES {
        bail!(
            "{} vectors are too many for a network on a GPU, which has at most {QUANTITIES}",
            quantities.len()
        );
    }
    let mut columns = Columns { count: quantities.len() as i32, ..Columns::default() };
    let mut end = 0;
    for (index, quantity) in quantities.iter().enumerate() {
        end += quantity.width;
        columns.end[index] = end as i32;
        columns.loss[index] = match quantity.loss {
            Loss::Squared => 0,
            Loss::Absolute => 1,
            Loss::Huber => 2,
        };
    }
    let op = VectorLosses { target: target.contiguous()?, columns, count: quantities.len(), parts };
    predicted.contiguous()?.apply_op1(op)
}

#[repr(C)]
#[derive(Clone, Copy, Default)]
struct Columns {
    count: i32,
    end: [i32; QUANTITIES],
    loss: [i32; QUANTITIES],
}
// SAFETY: the kernels declare the same fields.
unsafe impl DeviceRepr for Columns {}

struct VectorLosses {
    target: Tensor,
    columns: Columns,
    count: usize,
    /// Number of parts of the batch that have losses of their own.
    parts: usize,
}

impl CustomOp1 for VectorLosses {
    fn name(&self) -> &'static str {
        "vector-losses"
    }

    not_on_cpu!(CpuStorage);

    fn cuda_fwd(&self, predicted: &CudaStorage, layout: &Layout) -> Result<(CudaStorage, Shape)> {
        let (gpu, (batch, width)) = (Gpu::with(predicted), layout.shape().dims2()?);
        let predicted = slice(predicted, layout)?;
        let mut losses = gpu.scratch(self.count * self.parts)?;
        let config = LaunchConfig {
            grid_dim: (self.parts as u32, self.count as u32, 1),
            block_dim: (1024, 1, 1),
            shared_mem_bytes: 0,
        };
        let (rows, width) = ((batch / self.parts) as i32, width as i32);
        with_values(&self.target, |target| {
            let (losses, columns) = (&mut losses, &self.columns);
            launch!(
                gpu,
                VECTOR_LOSSES,
                "vector_losses",
                config,
                &predicted,
                target,
                losses,
                columns,
                &rows,
                &width
            );
            Ok(())
        })?;
        Ok(gpu.storage(losses, (self.count, self.parts)))
    }

    fn bwd(&self, predicted: &Tensor, _losses: &Tensor, grad: &Tensor) -> Result<Option<Tensor>> {
        let (gpu, (batch, width)) = (Gpu::of(predicted)?, predicted.dims2()?);
        let (rows, columns, parts) = ((batch / self.parts) as i32, width as i32, self.parts as i32);
        let mut out = gpu.scratch(batch * width)?;
        with_values(predicted, |predicted| {
            with_values(&self.target, |target| {
                with_values(grad, |grad| {
                    let config = each(batch * width);
                    launch!(
                        gpu,
                        VECTOR_LOSSES,
                        "vector_losses_backward",
                        config,
                        predicted,
                        target,
                        grad,
                        &mut out,
                        &self.columns,
                        &rows,
                        &columns,
                        &parts
                    );
                    Ok(())
                })
            })
        })?;
        Ok(Some(gpu.tensor(out, (batch, width))))
    }
}
