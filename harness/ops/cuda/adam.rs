//! Adam over all parameters in a few launches.

use super::{Gpu, launch};
use candle_core::cuda::cudarc::driver::{DevicePtr, DeviceRepr, DeviceSlice, LaunchConfig};
use candle_core::{Result, Storage, Tensor, bail};

/// The number of parameters in a launch.
const SLOTS: usize = 32;
/// The most blocks for one parameter.
const BLOCKS: usize = 256;
const THREADS: usize = 256;

/// A parameter, its gradient and its moments.
pub struct Slot<'a> {
    pub parameter: &'a Tensor,
    pub grad: Tensor,
    pub mean: &'a Tensor,
    pub square: &'a Tensor,
}

#[repr(C)]
#[derive(Clone, Copy, Default)]
struct Slots {
    parameter: [u64; SLOTS],
    grad: [u64; SLOTS],
    mean: [u64; SLOTS],
    square: [u64; SLOTS],
    len: [i32; SLOTS],
    decays: [i32; SLOTS],
}
// SAFETY: the kernel declares the same fields.
unsafe impl DeviceRepr for Slots {}

/// Takes a step over all parameters and their moments, in place. `constants` are the decay rates of both moments and
/// epsilon. `factors`, on the GPU, are the learning rate, the corrections of both moments, and the share of parameters
/// of rank 2 or more that remains after weight decay. `gradient_scale`, a scalar on the GPU, is the factor of the
/// gradients.
pub fn adam(
    [beta_mean, beta_square, epsilon]: [f32; 3],
    factors: &Tensor,
    slots: &[Slot],
    gradient_scale: &Tensor,
) -> Result<()> {
    let gpu = Gpu::of(gradient_scale)?;
    for slots in slots.chunks(SLOTS) {
        let mut pointers = Slots::default();
        let mut longest = 0;
        for (index, slot) in slots.iter().enumerate() {
            let len = slot.parameter.elem_count();
            for tensor in [slot.parameter, &slot.grad, slot.mean, slot.square] {
                if tensor.elem_count() != len || !tensor.is_contiguous() {
                    bail!("Adam works on contiguous tensors of equal shape");
                }
            }
            pointers.parameter[index] = pointer(slot.parameter)?;
            pointers.grad[index] = pointer(&slot.grad)?;
            pointers.mean[index] = pointer(slot.mean)?;
            pointers.square[index] = pointer(slot.square)?;
            pointers.len[index] = len as i32;
            pointers.decays[index] = i32::from(slot.parameter.rank() > 1);
            longest = longest.max(len);
        }
        let config = LaunchConfig {
            grid_dim: (longest.div_ceil(THREADS).clamp(1, BLOCKS) as u32, slots.len() as u32, 1),
            block_dim: (THREADS as u32, 1, 1),
            shared_mem_bytes: 0,
        };
        let (factors, scale) = (pointer(factors)?, pointer(gradient_scale)?);
        launch!(gpu, ADAM, "adam", config, &pointers, &beta_mean, &beta_square, &epsilon, &factors, &scale);
    }
    Ok(())
}

/// Returns the address of a tensor's first value. It holds as long as the tensor.
fn pointer(tensor: &Tensor) -> Result<u64> {
    let (storage, layout) = tensor.storage_and_layout();
    let Storage::Cuda(storage) = &*storage else { bail!("a GPU op was given a tensor of another device") };
    let values = storage.as_cuda_slice::<f32>()?.slice(layout.start_offset()..);
    let (address, _guard) = values.device_ptr(values.stream());
    Ok(address)
}
