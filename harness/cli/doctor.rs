//! `harness doctor`: checks this machine.

use super::table::{print_beside, shown};
use super::{DONE, FAILED};
use anyhow::Result;
use harness::experiment::describe;
use harness::files::free_bytes;
use harness::registry::Registry;
use harness::simulation::{MUJOCO_VERSION, mujoco_version, rendering};
use std::process::ExitCode;
use sysinfo::System;

/// Prints a line for each check. The exit code is [`FAILED`] if something that every run needs is missing.
pub fn execute(registry: &Registry, threads: usize) -> Result<ExitCode> {
    let mut healthy = true;
    let mut check = |name: &str, outcome: std::result::Result<String, String>| {
        let (mark, text) = match &outcome {
            Ok(text) => ("ok", text),
            Err(text) => ("FAIL", text),
        };
        healthy &= outcome.is_ok();
        print_beside([(format!("{mark:<5} {name:<9}"), text.clone())]);
    };
    check("rendering", renderer());
    check("MuJoCo", mujoco());
    check("threads", Ok(format!("{threads}{}", vector_width())));
    check("memory", Ok(memory()));
    check("results", results(registry));
    Ok(ExitCode::from(if healthy { DONE } else { FAILED }))
}

/// The OpenGL renderer and its device, with the variables that choose them in other programs and have no effect here.
fn renderer() -> std::result::Result<String, String> {
    const IGNORED: [&str; 3] = ["MUJOCO_GL", "MUJOCO_EGL_DEVICE_ID", "PYOPENGL_PLATFORM"];
    let (name, device) = rendering().map_err(|error| describe(&error))?;
    let device = device.map(|device| match device.devices {
        1 => ", the only device of EGL".to_owned(),
        devices => {
            format!(", EGL device {} of 0 to {}, the first that opens a context", device.index, devices - 1)
        }
    });
    let is_other = |value: &String| !matches!(value.as_str(), "" | "egl");
    let set = IGNORED.into_iter().filter_map(|name| Some((name, std::env::var(name).ok().filter(is_other)?)));
    let set: Vec<String> = set.map(|(name, value)| format!("{name}={value}")).collect();
    let ignored = match set.as_slice() {
        [] => String::new(),
        set => format!(
            "; {} {} no effect: the harness renders with EGL, on the first device that opens a context, and \
             __EGL_VENDOR_LIBRARY_FILENAMES chooses the driver",
            set.join(" and "),
            if set.len() == 1 { "has" } else { "have" }
        ),
    };
    Ok(format!("{name}{}{ignored}", device.unwrap_or_default()))
}

fn mujoco() -> std::result::Result<String, String> {
    match mujoco_version() {
        version if version == MUJOCO_VERSION => Ok(version.into()),
        version => Err(format!("{version} is linked, {MUJOCO_VERSION} is needed: run `make setup`")),
    }
}

/// The vector instructions that matrix products use, if they are AVX-512.
fn vector_width() -> &'static str {
    #[cfg(target_arch = "x86_64")]
    if std::arch::is_x86_feature_detected!("avx512f") {
        return ", AVX-512";
    }
    ""
}

fn memory() -> String {
    let mut system = System::new();
    system.refresh_memory();
    let gigabytes = |bytes: u64| bytes as f64 / 1e9;
    format!(
        "{:.1} GB free of {:.1} GB",
        gigabytes(system.available_memory()),
        gigabytes(system.total_memory())
    )
}

/// Checks whether the results folder can be written and locked, and reports the free space on its disk.
fn results(registry: &Registry) -> std::result::Result<String, String> {
    registry.check_writable().map_err(|error| error.to_string())?;
    let path = registry.root();
    let free = free_bytes(path).map_or(String::new(), |free| format!(", {:.1} GB free", free as f64 / 1e9));
    Ok(format!("{} can be written and locked{free}", shown(path)))
}
