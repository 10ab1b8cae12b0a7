//! Sealed safetensors files, which hold named tensors and a note in their metadata.
//!
//! Any reader of safetensors can open them. The note is JSON, under the key `harness` of the metadata.

use super::LearningError;
use candle_core::safetensors::Load;
use candle_core::{Device, Tensor};
use harness_shared::seal;
use safetensors::{Dtype, SafeTensors};
use serde_json::{Map, Value};
use std::collections::HashMap;
use std::path::Path;

/// Key of the note in a file's metadata.
const NOTE: &str = "harness";

/// Contents of a file.
#[derive(Debug)]
pub struct TensorFile {
    /// Tensors by name.
    pub tensors: HashMap<String, Tensor>,
    /// Additional JSON values by key.
    pub note: Map<String, Value>,
}

impl TensorFile {
    /// Writes the file with a seal. A failed write leaves no partial file.
    pub fn write(&self, path: &Path) -> Result<(), LearningError> {
        let mut note = self.note.clone();
        note.insert(seal::KEY.into(), seal::BLANK.into());
        let metadata = HashMap::from([(NOTE.to_owned(), Value::Object(note).to_string())]);
        let bytes = safetensors::serialize(&self.tensors, Some(metadata));
        let bytes = bytes.map_err(|error| candle_core::Error::Msg(error.to_string()))?;
        Ok(seal::write(path, bytes)?)
    }

    /// Reads a file that [`TensorFile::write`] has written.
    ///
    /// # Errors
    /// When the file can't be read, or its content has changed since it was written. The error names the file.
    pub fn read(path: &Path) -> Result<Self, LearningError> {
        let damaged = |reason: String| LearningError::Damaged { path: path.to_owned(), reason };
        let bytes = seal::read(path).map_err(|error| damaged(error.to_string()))?;
        Self::parse(&bytes).map_err(damaged)
    }

    /// Parses the bytes of a file from any writer, without checking a seal.
    ///
    /// # Errors
    /// When the bytes are no such file. Returns the reason.
    pub fn parse(bytes: &[u8]) -> Result<Self, String> {
        let (_, header) = SafeTensors::read_metadata(bytes).map_err(|error| error.to_string())?;
        let note =
            header.metadata().as_ref().and_then(|metadata| metadata.get(NOTE)).ok_or("it has no note")?;
        let note = serde_json::from_str(note).map_err(|error| error.to_string())?;
        let views = SafeTensors::deserialize(bytes).map_err(|error| error.to_string())?;
        let mut tensors = HashMap::new();
        for (name, view) in views.iter() {
            // candle would also load types that it can't compute with.
            if !matches!(view.dtype(), Dtype::U8 | Dtype::U32 | Dtype::I64 | Dtype::F32 | Dtype::F64) {
                return Err(format!("'{name}' holds {:?}", view.dtype()));
            }
            tensors.insert(name.to_owned(), view.load(&Device::Cpu).map_err(|error| error.to_string())?);
        }
        Ok(Self { tensors, note })
    }

    /// Returns the tensor `name` on the device of `like`. It must have the shape and type of `like`.
    ///
    /// # Errors
    /// When there is no such tensor, or it has another shape or type. Returns the reason.
    pub fn like(&self, name: &str, like: &Tensor) -> Result<Tensor, String> {
        let tensor = self.tensors.get(name).ok_or_else(|| format!("it has no tensor '{name}'"))?;
        if tensor.shape() != like.shape() || tensor.dtype() != like.dtype() {
            let of = |tensor: &Tensor| format!("{:?} of {:?}", tensor.shape(), tensor.dtype());
            return Err(format!("'{name}' is {}, not {}", of(tensor), of(like)));
        }
        tensor.to_device(like.device()).map_err(|error| error.to_string())
    }
}
