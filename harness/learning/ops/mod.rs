//! The network's own candle ops.
//!
//! candle's convolution gradients copy and its element-wise chains allocate; each op here does forward and
//! backward in as few passes over memory as the arithmetic allows. On a device other than the CPU the same
//! functions compose candle's own tensor operations, whose gradients candle knows.
//!
//! candle adds each gradient to a tensor of zeros, which costs three passes over it. The ops therefore hand over
//! the gradients of large weights directly; [`backward`] brings them together with candle's own.

mod adam;
mod dropout;
mod frame_encoder;
mod frame_loss;
mod linear;
mod posterior;
mod squared_errors;
mod two_layers;

pub use adam::Adam;
pub use dropout::Dropout;
pub use frame_encoder::frame_encoder;
pub use frame_loss::{FrameDecoder, frame_decoder, frame_loss};
pub use linear::linear;
pub use posterior::{divergence, sample};
pub use squared_errors::squared_errors;
pub use two_layers::{TwoLayers, two_layers};

use candle_core::backprop::GradStore;
use candle_core::{CpuStorage, Layout, Result, Storage, Tensor};
use std::cell::RefCell;

thread_local! {
    /// Weights and their gradients, from the ops whose backward pass runs on this thread.
    static HANDED_OVER: RefCell<Vec<(Tensor, Tensor)>> = const { RefCell::new(Vec::new()) };
}

/// The gradients of `loss` with regard to every variable. Use this instead of [`Tensor::backward`], which knows
/// nothing of the gradients that ops hand over.
pub fn backward(loss: &Tensor) -> Result<GradStore> {
    HANDED_OVER.take();
    let mut gradients = loss.backward()?;
    for (weight, gradient) in HANDED_OVER.take() {
        let sum = match gradients.get(&weight) {
            Some(other) => (other + gradient)?,
            None => gradient,
        };
        gradients.insert(&weight, sum);
    }
    Ok(gradients)
}

/// Whether a gradient of `weight` is wanted.
///
/// # Errors
/// When it is, and `weight` is no variable: a gradient that is handed over goes no further.
fn is_trained(weight: &Tensor) -> Result<bool> {
    if weight.track_op() && !weight.is_variable() {
        candle_core::bail!("an op was given weights that are computed from others");
    }
    Ok(weight.is_variable())
}

/// Leaves the gradient of a variable for [`backward`].
fn hand_over(weight: &Tensor, gradient: Vec<f32>) -> Result<()> {
    let gradient = tensor(gradient, weight.shape())?;
    HANDED_OVER.with_borrow_mut(|all| all.push((weight.clone(), gradient)));
    Ok(())
}

/// The values of a contiguous f32 tensor in CPU memory.
fn slice<'a>(storage: &'a CpuStorage, layout: &Layout) -> Result<&'a [f32]> {
    let (start, end) = layout
        .contiguous_offsets()
        .ok_or_else(|| candle_core::Error::RequiresContiguous { op: "harness op" }.bt())?;
    Ok(&storage.as_slice::<f32>()?[start..end])
}

/// Gives `read` the values of a contiguous f32 CPU tensor.
fn with_values<T>(tensor: &Tensor, read: impl FnOnce(&[f32]) -> Result<T>) -> Result<T> {
    let tensor = tensor.contiguous()?;
    let (storage, layout) = tensor.storage_and_layout();
    match &*storage {
        Storage::Cpu(storage) => read(slice(storage, layout)?),
        _ => candle_core::bail!("a CPU op was given a tensor of another device"),
    }
}

/// A CPU tensor around `values`.
fn tensor(values: Vec<f32>, shape: impl Into<candle_core::Shape>) -> Result<Tensor> {
    Tensor::from_vec(values, shape.into(), &candle_core::Device::Cpu)
}

/// Threads that a matrix product may use: those of the pool that the caller runs in.
fn threads() -> usize {
    rayon::current_num_threads()
}
