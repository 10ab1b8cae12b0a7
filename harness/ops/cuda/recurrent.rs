//! What the recurrent ops have in common: the division of their work among blocks, and gradients of weights.

use super::{Gpu, Matrix};
use crate::Arithmetic;
use candle_core::cuda::WrapErr;
use candle_core::cuda::cudarc::driver::sys::CUdevice_attribute as Attribute;
use candle_core::cuda::cudarc::driver::{CudaSlice, CudaView, CudaViewMut, DeviceRepr, LaunchConfig};
use candle_core::{Result, bail};

/// Number of threads in a block. It is that of `recurrent.cu`.
const THREADS: u32 = 512;
/// Greatest number of sequences that a warp multiplies at once. It is that of `recurrent.cu`.
const TILE: usize = 4;
/// Number of weights in a block below which waiting for more blocks takes longer than multiplying them.
const FEWEST_WEIGHTS: usize = 8192;

/// How the work is divided among blocks. The fields are those of `recurrent.cu`.
#[repr(C)]
#[derive(Clone, Copy)]
pub(super) struct Division {
    batch: i32,
    times: i32,
    sequences: i32,
    blocks: i32,
    tile: i32,
    longest: i32,
    stored: i32,
}

// SAFETY: the kernels declare a structure with the same fields.
unsafe impl DeviceRepr for Division {}

/// The weight of a product at each time: its number of outputs, and the number of weights of each.
pub(super) struct Weight {
    pub outputs: usize,
    pub len: usize,
}

/// A launch of a kernel for all times.
pub(super) struct Recurrence {
    pub gpu: Gpu,
    pub division: Division,
    pub config: LaunchConfig,
    /// The arrivals of each group's blocks.
    pub arrivals: CudaSlice<u32>,
}

impl Recurrence {
    /// Divides `batch` sequences of so many times among blocks. `longest` is the greatest number of values of a
    /// sequence in a product.
    pub fn new(gpu: &Gpu, [batch, times]: [usize; 2], longest: usize, weights: &[Weight]) -> Result<Self> {
        let stream = gpu.stream();
        let attribute =
            |attribute| Ok::<_, candle_core::Error>(stream.context().attribute(attribute).w()? as usize);
        // One block fits on each multiprocessor, so all of them run at once.
        let most_blocks = attribute(Attribute::CU_DEVICE_ATTRIBUTE_MULTIPROCESSOR_COUNT)?;
        let memory =
            attribute(Attribute::CU_DEVICE_ATTRIBUTE_MAX_SHARED_MEMORY_PER_BLOCK_OPTIN)? / size_of::<f32>();
        let Some(tile) = [TILE, TILE / 2, 1].into_iter().find(|tile| tile * longest <= memory) else {
            bail!("a product of {longest} values at each time does not fit in the shared memory of this GPU");
        };
        let share =
            |blocks: usize| weights.iter().map(|weight| weight.outputs.div_ceil(blocks) * weight.len).sum();
        let fewest = (1..=most_blocks).find(|blocks| tile * longest + share(*blocks) <= memory);

        let tiles = batch.div_ceil(tile);
        let groups = tiles.min(most_blocks / fewest.unwrap_or(1));
        let sequences = tiles.div_ceil(groups) * tile;
        let groups = batch.div_ceil(sequences);
        let all: usize = share(1);
        let blocks = all.div_ceil(FEWEST_WEIGHTS).clamp(fewest.unwrap_or(1), most_blocks / groups);
        let stored = fewest.map_or(0, |_| share(blocks));
        let division = Division {
            batch: batch as i32,
            times: times as i32,
            sequences: sequences as i32,
            blocks: blocks as i32,
            tile: tile as i32,
            longest: longest as i32,
            stored: i32::from(fewest.is_some()),
        };
        let config = LaunchConfig {
            grid_dim: ((groups * blocks) as u32, 1, 1),
            block_dim: (THREADS, 1, 1),
            shared_mem_bytes: ((tile * longest + stored) * size_of::<f32>()) as u32,
        };
        Ok(Self { gpu: gpu.clone(), division, config, arrivals: gpu.0.alloc_zeros(groups)? })
    }
}

/// Launches a kernel of `recurrent.cu` for all times: `recur!(recurrence, "name", arguments)`.
macro_rules! recur {
    ($recurrence:expr, $name:literal, $($argument:expr),+ $(,)?) => {{
        use candle_core::cuda::WrapErr;
        use candle_core::cuda::cudarc::driver::PushKernelArg;
        use candle_core::cuda::cudarc::driver::sys::CUfunction_attribute as Attribute;
        let $crate::cuda::recurrent::Recurrence { gpu, division, config, mut arrivals } = $recurrence;
        let function = gpu.function("RECURRENT", $crate::cuda::ptx::RECURRENT, $name)?;
        let memory = Attribute::CU_FUNC_ATTRIBUTE_MAX_DYNAMIC_SHARED_SIZE_BYTES;
        function.set_attribute(memory, config.shared_mem_bytes as i32).w()?;
        let stream = gpu.stream();
        // SAFETY: the arguments have the types that the kernel declares, and it reads and writes within their lengths.
        unsafe {
            stream
                .launch_builder(&function)
                .arg(&division)
                .arg(&mut arrivals)
                $(.arg($argument))+
                .launch_cooperative(config)
        }
        .w()?;
    }};
}
pub(super) use recur;

/// Computes the gradient `[outputs, columns]` of the weight of a product with the values before each time. `grad` is
/// that of the product, `[times * batch, outputs]`. The values before the first time are `start`, `[batch, columns]`,
/// and the others those of all times but the last in `values`, `[times * batch, columns]`.
pub(super) fn weight_gradient(
    gpu: &Gpu,
    grad: &CudaView<f32>,
    [start, values]: [&CudaView<f32>; 2],
    out: &mut CudaViewMut<f32>,
    [batch, columns]: [usize; 2],
    arithmetic: Arithmetic,
) -> Result<()> {
    let (rows, outputs) = (values.len() / columns, out.len() / columns);
    let mut product = |grad: &CudaView<f32>, values: &CudaView<f32>, add: bool| {
        let rows = values.len() / columns;
        let (grad, values) = (Matrix::transposed(grad, rows, outputs), Matrix::plain(values, rows, columns));
        gpu.product(grad, values, out, add, arithmetic)
    };
    let (first, others) = grad.split_at(batch * outputs);
    product(&first, start, false)?;
    if rows > batch {
        product(&others, &values.slice(..(rows - batch) * columns), true)?;
    }
    Ok(())
}
