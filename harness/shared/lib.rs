//! What every layer may use: files that are whole or absent and folders with one writer, digests inside files, the
//! memory there is, progress, and numbers as people write them.

pub mod files;
pub mod memory;
pub mod numbers;
pub mod progress;
pub mod seal;
pub mod shard;
