//! Loads the plugins that belong to MuJoCo: elastic cables and shells, touch grids, signed distance functions, and PID
//! actuators. MuJoCo's package has them in the folder `plugin` beside the library.

use libloading::Library;
use mujoco_rs::mujoco_c::{mj_version, mjp_getPlugin};
use std::ffi::{CStr, OsStr};
use std::os::unix::ffi::OsStrExt;
use std::path::{Path, PathBuf};
use std::sync::Once;

/// A plugin of MuJoCo's package. If it is known, another part of the process has loaded the package's plugins.
const KNOWN: &CStr = c"mujoco.elasticity.cable";

/// Loads the plugins of MuJoCo's package, unless they are loaded already. Without the folder, MuJoCo says which plugin
/// a model lacks.
pub(super) fn load_plugins() {
    static LOADED: Once = Once::new();
    LOADED.call_once(|| {
        // SAFETY: the name ends with a zero byte, and MuJoCo accepts null for a slot that is not wanted.
        let is_known = unsafe { !mjp_getPlugin(KNOWN.as_ptr(), std::ptr::null_mut()).is_null() };
        if !is_known {
            libraries().iter().for_each(|library| load(library));
        }
    });
}

/// Loads a library, which registers its plugins. A library that can't be loaded is left out.
fn load(library: &Path) {
    // SAFETY: the library is a part of MuJoCo's package, like the library in use. It only registers its plugins.
    if let Ok(loaded) = unsafe { Library::new(library) } {
        // Models may use the plugins until the process ends.
        std::mem::forget(loaded);
    }
}

/// The plugin libraries beside MuJoCo's library, in alphabetical order.
fn libraries() -> Vec<PathBuf> {
    let folder = library().and_then(|library| Some(library.parent()?.join("plugin")));
    let entries = folder.and_then(|folder| std::fs::read_dir(folder).ok());
    let files = entries.into_iter().flatten().flatten().map(|entry| entry.path());
    let mut files: Vec<PathBuf> = files.filter(|file| file.extension() == Some(OsStr::new("so"))).collect();
    files.sort();
    files
}

/// The file of the MuJoCo library that this process has loaded, with links resolved.
fn library() -> Option<PathBuf> {
    let mut found = libc::Dl_info {
        dli_fname: std::ptr::null(),
        dli_fbase: std::ptr::null_mut(),
        dli_sname: std::ptr::null(),
        dli_saddr: std::ptr::null_mut(),
    };
    // SAFETY: the address is that of a function of the library, and `found` is valid for writing. If the call succeeds,
    // the name is null or a text that lives as long as the library.
    let name = unsafe {
        let is_found = libc::dladdr(mj_version as *const libc::c_void, &raw mut found) != 0;
        (is_found && !found.dli_fname.is_null()).then(|| CStr::from_ptr(found.dli_fname))?
    };
    std::fs::canonicalize(OsStr::from_bytes(name.to_bytes())).ok()
}
