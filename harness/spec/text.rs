//! Reads the text of specs and worlds.

use super::error::SpecError;
use harness_shared::path_word;
use std::ffi::OsStr;
use std::fs::File;
use std::io::Read;
use std::path::Path;

/// Size of the largest file that is read, bytes.
pub(super) const MAX_FILE_BYTES: u64 = 1 << 20;

/// The endings of the files of models.
const MODELS: [&str; 4] = ["xml", "urdf", "mjb", "mjz"];

/// Reads the text of a YAML file.
///
/// # Errors
/// When the file is missing, is a directory or a model, is larger than 1 MiB, can't be read, or is not UTF-8.
pub fn read_text(path: &Path) -> Result<String, SpecError> {
    let unreadable = |message: String| SpecError::Unreadable { path: path.display().to_string(), message };
    if path.is_dir() {
        return Err(unreadable("is a directory; name a YAML file in it".into()));
    }
    let file = File::open(path).map_err(|error| match error.kind() {
        std::io::ErrorKind::NotFound => unreadable("there is no such file".into()),
        _ => unreadable(format!("can't be opened: {error}")),
    })?;
    let is_model = |ending: &OsStr| MODELS.iter().any(|model| ending.eq_ignore_ascii_case(model));
    if path.extension().is_some_and(is_model) {
        return Err(unreadable(format!(
            "is a model; `harness world new {}` writes a world file for it",
            path_word(path)
        )));
    }
    let mut bytes = Vec::new();
    // Reading one byte more than allowed detects a file that is too large, even a pipe, whose metadata has no size.
    file.take(MAX_FILE_BYTES + 1)
        .read_to_end(&mut bytes)
        .map_err(|error| unreadable(format!("can't be read: {error}")))?;
    if bytes.len() as u64 > MAX_FILE_BYTES {
        return Err(unreadable("is larger than 1 MiB; it must be a short text".into()));
    }
    String::from_utf8(bytes).map_err(|error| {
        let valid = &error.as_bytes()[..error.utf8_error().valid_up_to()];
        let line = valid.iter().filter(|&&byte| byte == b'\n').count() + 1;
        unreadable(format!("is not UTF-8 text: the first bad byte is on line {line}"))
    })
}
