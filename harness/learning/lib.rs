//! Networks, their own candle ops, and their training. Knows tensors and datasets, not MuJoCo.

pub mod checkpoint;
pub mod frames;
pub mod memory;
pub mod network;
mod normalizer;
pub mod objective;
pub mod ops;
pub mod predict;
pub mod random;
pub mod state;
pub mod tensors;
pub mod training;

pub use normalizer::{Normalizer, Normalizers};

use harness_shared::files::WriteError;
use harness_spec::{Device, Task};
use std::path::PathBuf;
use training::Losses;

/// The version of candle that this was built with.
pub const CANDLE_VERSION: &str = env!("CANDLE_VERSION");

/// Keeps candle from starting threads of its own beside rayon's: they wait for work without sleeping, and what is left
/// to them is short. A value of `CANDLE_NUM_THREADS` that the user set is kept.
///
/// # Safety
/// To be called before any other thread exists: the environment belongs to the whole process.
pub unsafe fn prepare_threads() {
    const THREADS: &str = "CANDLE_NUM_THREADS";
    if std::env::var_os(THREADS).is_none() {
        // SAFETY: the caller vouches that this thread is the only one.
        unsafe { std::env::set_var(THREADS, "1") };
    }
}

/// The device that a training asks for.
///
/// # Errors
/// When this harness was built without it, or this machine lacks it.
pub fn open_device(device: Device) -> Result<candle_core::Device, LearningError> {
    if device == Device::Cpu {
        return Ok(candle_core::Device::Cpu);
    }
    if !candle_core::utils::cuda_is_available() {
        let reason =
            "this harness was built without CUDA; build it with `cargo build --features cuda`, or use cpu";
        return Err(LearningError::Device { device, reason: reason.into() });
    }
    candle_core::Device::new_cuda(0)
        .map_err(|error| LearningError::Device { device, reason: first_line(&error) })
}

/// Why a training ended early.
#[derive(Debug, thiserror::Error)]
pub enum LearningError {
    #[error(
        "the loss of the {task:?} was no longer finite in epoch {epoch} ({losses:?}); \
         try a smaller training.learning_rate"
    )]
    NotFinite { task: Task, epoch: usize, losses: Losses },
    #[error("the training was cancelled; the same command goes on from the last saved state")]
    Cancelled,
    #[error("{} is damaged ({reason}); delete it and run the same command again", path.display())]
    Damaged { path: PathBuf, reason: String },
    #[error(transparent)]
    Write(#[from] WriteError),
    #[error("training.device: {device} can't be used: {reason}")]
    Device { device: Device, reason: String },
    #[error("candle: {}", first_line(.0))]
    Candle(#[from] candle_core::Error),
}

/// candle's errors carry a backtrace below their first line where one was asked for.
fn first_line(error: &candle_core::Error) -> String {
    error.to_string().lines().next().unwrap_or_default().to_owned()
}
