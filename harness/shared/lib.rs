//! Basics for all other crates: complete files and locked folders, seals, available memory, progress, turns of
//! processes, numbers and command lines as text, a low-discrepancy sequence, and the name that was probably meant.

pub mod files;
pub mod memory;
mod nearest;
pub mod numbers;
pub mod progress;
pub mod seal;
pub mod shard;
mod shell;
mod sobol;
pub mod turns;

pub use nearest::{meant, nearest};
pub use shell::{path_word, quoted};
pub use sobol::{SOBOL_DIMENSIONS, sobol};
