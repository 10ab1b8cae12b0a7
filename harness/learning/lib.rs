//! Networks and their training. This crate knows tensors and datasets, but not MuJoCo.

pub mod checkpoint;
pub mod data;
pub mod levels;
pub mod marginal;
pub mod memory;
pub mod network;
pub mod objective;
mod observation;
pub mod onnx;
pub mod predict;
pub mod random;
pub mod state;
mod steps;
pub mod tensors;
pub mod training;

use harness_shared::files::WriteError;
use harness_spec::{Device, Task};
use std::path::PathBuf;
use training::Losses;

/// The version of candle that this crate was built with.
pub const CANDLE_VERSION: &str = env!("CANDLE_VERSION");

/// Prevents candle from starting its own threads beside rayon's. candle's threads spin while they wait, and only short
/// operations are left to them. A value of `CANDLE_NUM_THREADS` that the user has set is kept.
///
/// # Safety
/// Call this function before any other thread exists, because it changes the environment of the whole process.
pub unsafe fn prepare_threads() {
    const THREADS: &str = "CANDLE_NUM_THREADS";
    if std::env::var_os(THREADS).is_none() {
        // SAFETY: the caller guarantees that no other thread exists.
        unsafe { std::env::set_var(THREADS, "1") };
    }
}

/// Opens the device that a training asks for.
///
/// # Errors
/// When this program was built without support for the device, or this machine has no such device.
pub fn open_device(device: Device) -> Result<candle_core::Device, LearningError> {
    if device == Device::Cpu {
        return Ok(candle_core::Device::Cpu);
    }
    if !candle_core::utils::cuda_is_available() {
        let reason =
            "this harness was built without CUDA; build it with `cargo build --features cuda`, or use cpu";
        return Err(LearningError::Device { device, reason: reason.into() });
    }
    harness_ops::open_gpu().map_err(|error| LearningError::Device { device, reason: first_line(&error) })
}

/// An error that ends a training, or the loading of a trained network.
#[derive(Debug, thiserror::Error)]
pub enum LearningError {
    /// A loss became infinite or NaN.
    #[error(
        "the {split} loss of the {task} was no longer finite in epoch {epoch} ({}); try a smaller \
         training.learning_rate",
        losses.iter().map(|(term, value)| format!("{term} {value}")).collect::<Vec<_>>().join(", ")
    )]
    NotFinite {
        /// What was being trained.
        task: Task,
        /// The epoch, counted from 1.
        epoch: usize,
        /// `training` or `validation`: the samples that the loss is of.
        split: &'static str,
        /// The terms of the loss that are not finite, with their means over the epoch.
        losses: Losses,
    },
    /// The caller cancelled the training.
    #[error("the training was cancelled; the same command continues from the last saved state")]
    Cancelled,
    /// A state or a checkpoint is damaged, or does not fit the network.
    #[error("{} is damaged ({reason})", path.display())]
    Damaged {
        /// The damaged file.
        path: PathBuf,
        /// What is wrong with it.
        reason: String,
    },
    /// A file can't be written.
    #[error(transparent)]
    Write(#[from] WriteError),
    /// The device of the training can't be used.
    #[error("training.device: {device} can't be used: {reason}")]
    Device {
        /// The device that the spec asks for.
        device: Device,
        /// Why it can't be used.
        reason: String,
    },
    /// The GPU has too little free memory.
    #[error(
        "the GPU has too little free memory; end other programs on it, reduce training.batch_size or the network, or \
         set training.device: cpu"
    )]
    GpuMemory,
    /// A tensor operation failed.
    #[error("candle: {}", first_line(.0))]
    Candle(candle_core::Error),
}

impl From<candle_core::Error> for LearningError {
    fn from(error: candle_core::Error) -> Self {
        let text = error.to_string();
        // Those of the driver and of cuBLAS.
        let is_of_memory =
            ["CUDA_ERROR_OUT_OF_MEMORY", "CUBLAS_STATUS_ALLOC_FAILED"].iter().any(|name| text.contains(name));
        if is_of_memory { Self::GpuMemory } else { Self::Candle(error) }
    }
}

/// Returns the first line of an error. candle appends a backtrace below it if backtraces are enabled.
fn first_line(error: &candle_core::Error) -> String {
    error.to_string().lines().next().unwrap_or_default().to_owned()
}
