//! The specs that are part of the program, and how a file is found by its path or its name.

use super::error::SpecError;
use super::text::read_text;
use crate::yaml::not_known;
use std::borrow::Cow;
use std::ffi::OsStr;
use std::path::{Path, PathBuf};

/// A built-in file in `experiments/`.
#[derive(Debug, Clone, Copy)]
pub struct BuiltIn {
    /// The file's name without extension.
    pub name: &'static str,
    /// The file's text.
    pub text: &'static str,
}

macro_rules! built_in {
    ($($name:literal),* $(,)?) => {
        &[$(BuiltIn { name: $name, text: include_str!(concat!("../../experiments/", $name, ".yaml")) }),*]
    };
}

/// All specs in `experiments/`, in the order of their names.
pub const SPECS: &[BuiltIn] = built_in![
    "choose_camera",
    "choose_recommended",
    "first",
    "hidden_stiffness",
    "history",
    "intervals",
    "missing",
    "multi_to_multi",
    "noise",
    "oracle",
    "probes",
    "recalibration",
    "recommended",
    "reproduction",
    "search",
    "shift",
    "single_to_multi",
    "smoke",
    "which_sense",
    "which_sense_crowded",
    "which_touch",
];

impl BuiltIn {
    /// The name of the file in messages.
    pub fn label(self) -> String {
        format!("the built-in experiments/{}.yaml", self.name)
    }
}

/// A YAML file, from the disk or from the program.
#[derive(Debug)]
pub struct YamlFile {
    /// The name of the file in messages.
    pub label: String,
    /// The folder that paths in the file are relative to. For a built-in file, it is the current folder.
    pub folder: PathBuf,
    /// The text.
    pub text: Cow<'static, str>,
}

impl From<BuiltIn> for YamlFile {
    fn from(file: BuiltIn) -> Self {
        Self { label: file.label(), folder: PathBuf::new(), text: file.text.into() }
    }
}

/// Finds a file by its path, or by its name without folder and extension. The name `NAME` stands for the first of
/// these that exists: the file `NAME.yaml`, the file `experiments/NAME.yaml`, and the file of this name in `built_in`.
/// Messages call such a file a `what`.
pub fn find(what: &str, path: &Path, built_in: &[BuiltIn]) -> Result<YamlFile, SpecError> {
    let is_file = path.exists() && !path.is_dir();
    match path.to_str() {
        Some(name) if !is_file && !name.is_empty() && !name.contains(['/', '.']) => {
            by_name(what, name, built_in)
        }
        _ if path.exists() => read(path),
        _ => read(path).map_err(|error| match named(path.file_stem(), built_in) {
            Some(BuiltIn { name, .. }) => SpecError::Unreadable {
                path: path.display().to_string(),
                message: format!("there is no such file; the built-in {what} has the name '{name}'"),
            },
            None => error,
        }),
    }
}

fn by_name(what: &str, name: &str, built_in: &[BuiltIn]) -> Result<YamlFile, SpecError> {
    let files = [format!("{name}.yaml"), format!("experiments/{name}.yaml")];
    if let Some(file) = files.iter().map(Path::new).find(|file| file.is_file()) {
        return read(file);
    }
    if let Some(file) = named(Some(name.as_ref()), built_in) {
        return Ok(file.into());
    }
    let names: Vec<&str> = built_in.iter().map(|file| file.name).collect();
    let message = not_known(what, name, "", &names, str::to_owned);
    Err(SpecError::NoFile {
        message: format!("{message} Allowed: {}, or the path of a file", names.join(", ")),
    })
}

/// Finds the file that `file` names: one relative to its folder, or else one of `built_in`. A built-in file names only
/// those, whatever the current folder has.
pub(super) fn beside(file: &YamlFile, name: &str, built_in: &[BuiltIn]) -> Result<YamlFile, SpecError> {
    let path = file.folder.join(name);
    match named(Path::new(name).file_stem(), built_in) {
        Some(own) if !name.contains('/') && (matches!(file.text, Cow::Borrowed(_)) || !path.exists()) => {
            Ok(own.into())
        }
        _ => read(&path),
    }
}

fn named(name: Option<&OsStr>, built_in: &[BuiltIn]) -> Option<BuiltIn> {
    built_in.iter().find(|file| name.is_some_and(|name| name == file.name)).copied()
}

fn read(path: &Path) -> Result<YamlFile, SpecError> {
    Ok(YamlFile {
        label: path.display().to_string(),
        folder: path.parent().unwrap_or(Path::new("")).to_owned(),
        text: read_text(path)?.into(),
    })
}
