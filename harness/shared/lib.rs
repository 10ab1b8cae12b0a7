//! Basics for all other crates: complete files and locked folders, seals, available memory, progress, turns of
//! processes, and numbers as text.

pub mod files;
pub mod memory;
pub mod numbers;
pub mod progress;
pub mod seal;
pub mod shard;
pub mod turns;
