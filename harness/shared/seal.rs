//! Seals: a digest inside a file over every byte of it, so that no damaged file is taken for a whole one.
//!
//! A file is made with [`BLANK`] somewhere in its metadata. Its seal is the SHA-256 of the file as it then is, in
//! hexadecimal, and takes the place of the blank's dashes. Whoever reads the file puts the dashes back and compares:
//! any change of any bit, a missing end and a part of another file are noticed before a decoder sees them.

use crate::files::{WriteError, write_bytes};
use sha2::{Digest, Sha256};
use std::path::Path;

/// Stands in a file's metadata before it is sealed.
pub const BLANK: &str = "sha256-seal:----------------------------------------------------------------";
/// Key under which formats with named metadata keep the seal.
pub const KEY: &str = "seal";

const PREFIX: &str = "sha256-seal:";
const DIGITS: usize = BLANK.len() - PREFIX.len();

/// Why a sealed file could not be read.
#[derive(Debug, thiserror::Error)]
pub enum SealError {
    #[error("{0}")]
    Read(#[from] std::io::Error),
    #[error("it has no seal: its end is missing, or this version did not write it")]
    Missing,
    #[error("it is not as it was written: its SHA-256 differs")]
    Broken,
}

/// Seals the bytes of a file in which [`BLANK`] stands; of several, the last is taken.
///
/// # Errors
/// When there is no blank.
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

/// Seals `bytes` and writes them as a whole file.
pub fn write(path: &Path, mut bytes: Vec<u8>) -> Result<(), WriteError> {
    seal(&mut bytes)
        .map_err(|error| WriteError { path: path.to_owned(), source: std::io::Error::other(error) })?;
    write_bytes(path, &bytes)
}

/// Reads a file whose seal holds.
pub fn read(path: &Path) -> Result<Vec<u8>, SealError> {
    let bytes = std::fs::read(path)?;
    check(&bytes)?;
    Ok(bytes)
}

/// Bytes in hexadecimal.
pub fn hex(bytes: &[u8]) -> String {
    bytes.iter().map(|byte| format!("{byte:02x}")).collect()
}
