//! Basics for all other crates: complete files and locked folders, seals, available memory, progress, numbers and
//! command lines as text, and the name that was probably meant.

pub mod files;
pub mod memory;
mod nearest;
pub mod numbers;
pub mod progress;
pub mod seal;
mod shell;

pub use nearest::{meant, nearest};
pub use shell::{path_word, quoted};
