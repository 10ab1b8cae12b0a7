//! The networks' custom candle ops, and batches of frames that they take one frame at a time.
//!
//! candle's convolution gradients copy their operands, and its chains of element-wise operations allocate every
//! intermediate result. Each op here computes its forward and backward pass in as few passes over memory as possible.
//! For a GPU, the module `cuda` has the same functions.

mod adam;
mod arguments;
#[cfg(feature = "cuda")]
mod cuda;
mod dropout;
mod frame_encoder;
mod frame_loss;
pub mod frames;
mod gru;
mod linear;
mod posterior;
mod rssm;
mod scores;
mod stack;
mod two_layers;
mod vector_losses;

pub use adam::Adam;
pub use arguments::{FrameDecoder, Gated, Quantity, Sequences, StateSpace, TwoLayers};
#[cfg(feature = "cuda")]
pub use cuda::graph;
pub use dropout::Dropout;
pub use frame_encoder::frame_encoder;
pub use frame_loss::{frame_decoder, frame_loss};
pub use gru::gru;
pub use linear::linear;
pub use posterior::{balanced_divergence, divergences, kl_divergence, sample};
pub use rssm::rssm;
pub use scores::{
    categorical_cross_entropy, cosine_losses, cross_entropy, gaussian_crps, interval_score, softplus,
    truncated_laplace_crps, truncated_laplace_mean, truncated_laplace_quantiles,
};
pub use stack::Stack;
pub use two_layers::two_layers;
pub use vector_losses::{composed, vector_losses};

pub use harness_kernels::product::Arithmetic;

use candle_core::{CpuStorage, Device, Layout, Result, Storage, Tensor};
use harness_kernels::product::{self, Unit};
use harness_spec::Precision;

/// Returns how a network's matrix products are computed. `tiles` allows the processor's tile unit (AMX), if it has one.
pub fn arithmetic(tiles: bool, precision: Precision) -> Arithmetic {
    Arithmetic {
        unit: if tiles { Unit::best() } else { Unit::Vectors },
        precision: match precision {
            Precision::F32 => product::Precision::F32,
            Precision::Bf16 => product::Precision::Bf16,
            Precision::Tf32 => product::Precision::Tf32,
        },
    }
}

/// Returns the values of a contiguous f32 tensor in CPU memory.
fn slice<'a>(storage: &'a CpuStorage, layout: &Layout) -> Result<&'a [f32]> {
    let (start, end) = layout
        .contiguous_offsets()
        .ok_or_else(|| candle_core::Error::RequiresContiguous { op: "harness op" }.bt())?;
    Ok(&storage.as_slice::<f32>()?[start..end])
}

/// Calls `read` with the values of an f32 tensor. Fails if the tensor is not in CPU memory.
fn with_values<T>(tensor: &Tensor, read: impl FnOnce(&[f32]) -> Result<T>) -> Result<T> {
    let tensor = tensor.contiguous()?;
    let (storage, layout) = tensor.storage_and_layout();
    match &*storage {
        Storage::Cpu(storage) => read(slice(storage, layout)?),
        _ => candle_core::bail!("a CPU op was given a tensor of another device"),
    }
}

/// Creates a CPU tensor of `values`.
fn tensor(values: Vec<f32>, shape: impl Into<candle_core::Shape>) -> Result<Tensor> {
    Tensor::from_vec(values, shape.into(), &candle_core::Device::Cpu)
}

/// Opens the first GPU.
///
/// # Errors
/// When this program was built without CUDA, or the machine has no GPU or no driver.
pub fn open_gpu() -> Result<Device> {
    #[cfg(feature = "cuda")]
    return cuda::open();
    #[cfg(not(feature = "cuda"))]
    candle_core::bail!("this program was built without CUDA")
}

/// Values that the host gives to a training step.
#[derive(Debug, Clone, PartialEq)]
pub enum Values {
    /// Numbers.
    F32(Vec<f32>),
    /// Indices, or the words of a key.
    U32(Vec<u32>),
}

impl Values {
    /// Returns the number of values.
    pub fn len(&self) -> usize {
        match self {
            Self::F32(values) => values.len(),
            Self::U32(values) => values.len(),
        }
    }

    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }
}

/// Copies values to a device, as an input of a training step.
///
/// # Errors
/// When the device has too little memory.
pub fn input(values: Values, shape: impl Into<candle_core::Shape>, device: &Device) -> Result<Tensor> {
    #[cfg(feature = "cuda")]
    if device.is_cuda() {
        return cuda::graph::copied(values, shape, device);
    }
    match values {
        Values::F32(values) => Tensor::from_vec(values, shape.into(), device),
        Values::U32(values) => Tensor::from_vec(values, shape.into(), device),
    }
}

/// Returns the rows of `x` `[batch, width]`, each normalized to mean 0 and variance 1, multiplied by `weight` and added
/// to `bias` (layer normalization). `epsilon` is added to the variance.
pub fn norm(x: &Tensor, weight: &Tensor, bias: &Tensor, epsilon: f32) -> Result<Tensor> {
    #[cfg(feature = "cuda")]
    if x.device().is_cuda() {
        return cuda::norm(x, weight, bias, epsilon);
    }
    // candle-nn's other layer normalization has no gradient.
    candle_nn::ops::layer_norm_slow(x, weight, bias, epsilon)
}

/// Returns the number of threads that a matrix product may use: those of the caller's rayon pool.
fn threads() -> usize {
    rayon::current_num_threads()
}
