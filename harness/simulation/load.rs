//! Compiles MJCF, and passes on the whole of MuJoCo's message if it can't be compiled.

use super::SimulationError;
use harness_shared::quoted;
use mujoco_rs::mujoco_c::{mj_deleteModel, mj_loadXML, mjVFS};
use mujoco_rs::prelude::*;
use mujoco_rs::wrappers::MjVfs;
use std::ffi::{CStr, CString, c_char, c_int};
use std::path::Path;

/// Room for MuJoCo's longest message, bytes. The bindings have room for its first 99 characters only.
const MESSAGE_LEN: usize = 4096;

/// The first bytes of archives in the format Zip, such as MuJoCo's `.mjz`.
const ZIP: &[u8] = b"PK\x03\x04";

/// Reads the file of a model. The error says why it can't be, and what to do.
pub(super) fn read_model(path: &Path) -> Result<Vec<u8>, String> {
    if path.is_dir() {
        return Err("it is a folder; name the MJCF file in it".into());
    }
    // MuJoCo reads the file again, and nobody may write to a pipe.
    let metadata = path.metadata().map_err(|error| error.to_string())?;
    if !metadata.is_file() {
        return Err("it is a pipe or a device; name the file of a model".into());
    }
    let bytes = std::fs::read(path).map_err(|error| error.to_string())?;
    let (archive, folder) = (path.to_string_lossy(), path.with_extension(""));
    let folder = folder.to_string_lossy();
    if bytes.starts_with(ZIP) {
        return Err(format!(
            "it is an archive; unpack it with `{}`, and name the MJCF file in the folder",
            quoted([
                "python3",
                "-m",
                "zipfile",
                "-e",
                &archive,
                if folder == archive { "model" } else { &folder }
            ])
        ));
    }
    if bytes.contains(&0) {
        return Err(
            "it is no text; a compiled model (.mjb) suits one version of MuJoCo only, so name the MJCF file \
                    that it was compiled from"
                .into(),
        );
    }
    // A byte order mark may come before the text.
    if !bytes.strip_prefix(b"\xEF\xBB\xBF").unwrap_or(&bytes).trim_ascii_start().starts_with(b"<") {
        let is_world = path.extension().is_some_and(|ending| ending == "yaml" || ending == "yml");
        let check = quoted(["harness", "world", "check", &archive]);
        let hint = if is_world { format!("; `{check}` checks a world file") } else { String::new() };
        return Err(format!("it is no XML, as models in MJCF and URDF are{hint}"));
    }
    Ok(bytes)
}

/// Refuses a file that can't be the model of a world, before anything else is done with its path.
///
/// # Errors
/// When the file can't be read, or is no XML.
pub fn check_model(path: &Path) -> Result<(), SimulationError> {
    let unsuitable = |problem| SimulationError::Unsuitable { scene: path.display().to_string(), problem };
    read_model(path).map(drop).map_err(unsuitable)
}

/// Compiles an MJCF file.
pub(super) fn load_file(path: &Path) -> Result<MjModel, SimulationError> {
    let name = path.display().to_string();
    let model = MjModel::from_xml(path).map_err(|error| {
        let whole = path.to_str().and_then(|path| message(path, std::ptr::null()));
        compile_error(&name, whole.map_or(error, MjModelError::LoadFailed))
    })?;
    refuse_fatal(model, &name)
}

/// Compiles MJCF text, which messages call `name`.
pub(super) fn load_text(xml: &str, name: &str) -> Result<MjModel, SimulationError> {
    let model = MjModel::from_xml_string(xml).map_err(|error| {
        let (file, mut files) = ("model.xml", MjVfs::new());
        let added = files.add_from_buffer(file, xml.as_bytes());
        let whole = added.ok().and_then(|()| message(file, files.ffi()));
        compile_error(name, whole.map_or(error, MjModelError::LoadFailed))
    })?;
    refuse_fatal(model, name)
}

/// Refuses a model that compiles, but whose first step would end the process.
fn refuse_fatal(model: MjModel, name: &str) -> Result<MjModel, SimulationError> {
    let couples =
        |equality: usize| model.eq_type()[equality] == MjtEq::mjEQ_TENDON && model.eq_active0()[equality];
    if can_sleep(&model) && (0..model.neq() as usize).any(couples) {
        let problem =
            "MuJoCo does not support sleep=\"enable\" with an equality of tendons; remove the flag, or the \
                       equality"
                .to_owned();
        return Err(SimulationError::Unsuitable { scene: name.to_owned(), problem });
    }
    Ok(model)
}

/// Whether bodies of a model can fall asleep.
pub(super) fn can_sleep(model: &MjModel) -> bool {
    model.opt().enableflags & MjtEnableBit::mjENBL_SLEEP as i32 != 0
}

/// Returns the reason why MuJoCo can't compile a file, with the path that messages call the model.
pub(super) fn compile_error(scene: &str, error: MjModelError) -> SimulationError {
    let message = match error {
        // MuJoCo puts the element and its line below what is wrong with it.
        MjModelError::LoadFailed(message) => {
            let is_part = message.contains("Unrecognized XML model type");
            let advice = "; if other models include this file, name one of them";
            message.trim().replace('\n', "; ") + if is_part { advice } else { "" }
        }
        other => other.to_string(),
    };
    SimulationError::Compile { scene: scene.to_owned(), message }
}

/// Returns MuJoCo's whole message about a file that it can't compile; `None` if it can by now. The file is in `files`
/// or, if that is null, on the disk.
fn message(file: &str, files: *const mjVFS) -> Option<String> {
    let (file, mut text) = (CString::new(file).ok()?, [0 as c_char; MESSAGE_LEN]);
    // SAFETY: the file's name ends with a zero byte, `files` is null or valid, and MuJoCo writes at most the given
    // number of bytes, of which the last one is zero.
    unsafe {
        let model = mj_loadXML(file.as_ptr(), files, text.as_mut_ptr(), text.len() as c_int);
        if !model.is_null() {
            mj_deleteModel(model);
            return None;
        }
        Some(CStr::from_ptr(text.as_ptr()).to_string_lossy().into_owned())
    }
}
