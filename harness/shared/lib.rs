//! Basics for all other crates: complete files and locked folders, seals, available memory, progress, and numbers as
//! text.

pub mod files;
pub mod memory;
pub mod numbers;
pub mod progress;
pub mod seal;
pub mod shard;
