//! Seals. A seal is a digest of all bytes of a file, stored in the file itself. It detects damaged files.
//!
//! A file is first created with [`BLANK`] in its metadata. Its seal is the SHA-256 of these bytes, in hexadecimal,
//! which replaces the dashes of the blank. A reader puts the dashes back and compares. So any changed bit, a missing
//! end, and a part of another file are detected before a decoder reads the file.

use crate::files::{WriteError, write_bytes};
use sha2::{Digest, Sha256};
use std::path::Path;

/// The placeholder of the seal in a file's metadata.
pub const BLANK: &str = "sha256-seal:----------------------------------------------------------------";
/// Key of the seal in formats with named metadata.
pub const KEY: &str = "seal";

const PREFIX: &str = "sha256-seal:";
const DIGITS: usize = BLANK.len() - PREFIX.len();

/// Why a sealed file could not be read.
#[derive(Debug, thiserror::Error)]
pub enum SealError {
    /// The file can't be read.
    #[error("{0}")]
    Read(#[from] std::io::Error),
    /// The file has no seal.
    #[error("it has no seal: its end is missing, or this version did not write it")]
    Missing,
    /// The content does not match the seal.
    #[error("it has changed since it was written: its SHA-256 differs")]
    Broken,
}

/// Seals the bytes of a file that contains [`BLANK`]. If it occurs several times, the last one is replaced.
pub fn seal(bytes: &mut [u8]) -> Result<(), SealError> {
    let at = memchr::memmem::rfind(bytes, BLANK.as_bytes()).ok_or(SealError::Missing)?;
    let digest = hex(&Sha256::digest(&*bytes));
    bytes[at + PREFIX.len()..at + BLANK.len()].copy_from_slice(digest.as_bytes());
    Ok(())
}

/// Compares a file's bytes with their seal.
pub fn check(bytes: &[u8]) -> Result<(), SealError> {
    let at = memchr::memmem::rfind(bytes, PREFIX.as_bytes()).ok_or(SealError::Missing)? + PREFIX.len();
    let found = bytes.get(at..at + DIGITS).ok_or(SealError::Missing)?;
    let mut hash = Sha256::new();
    hash.update(&bytes[..at]);
    hash.update(&BLANK[PREFIX.len()..]);
    hash.update(&bytes[at + DIGITS..]);
    if hex(&hash.finalize()).as_bytes() == found { Ok(()) } else { Err(SealError::Broken) }
}

/// Seals `bytes` and writes them to a file, completely or not at all.
pub fn write(path: &Path, mut bytes: Vec<u8>) -> Result<(), WriteError> {
    seal(&mut bytes)
        .map_err(|error| WriteError { path: path.to_owned(), source: std::io::Error::other(error) })?;
    write_bytes(path, &bytes)
}

/// Reads a sealed file. Fails if its seal is missing or does not match.
pub fn read(path: &Path) -> Result<Vec<u8>, SealError> {
    let bytes = std::fs::read(path)?;
    check(&bytes)?;
    Ok(bytes)
}

/// Formats bytes in hexadecimal.
pub fn hex(bytes: &[u8]) -> String {
    bytes.iter().map(|byte| format!("{byte:02x}")).collect()
}
