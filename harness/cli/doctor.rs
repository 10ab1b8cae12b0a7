//! `harness doctor`: checks this machine.

use super::table::{print_beside, shown};
use super::{DONE, FAILED};
use anyhow::Result;
use harness::experiment::describe;
use harness::files::free_bytes;
use harness::registry::Registry;
use harness::simulation::{MUJOCO_VERSION, mujoco_version, renderer_name};
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
    check("rendering", renderer_name().map_err(|error| describe(&error)));
    check("MuJoCo", mujoco());
    check("threads", Ok(format!("{threads}{}", vector_width())));
    check("memory", Ok(memory()));
    check("results", results(registry));
    Ok(ExitCode::from(if healthy { DONE } else { FAILED }))
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

/// Checks whether the results folder can be written, and reports the free space on its disk.
fn results(registry: &Registry) -> std::result::Result<String, String> {
    registry.check_writable().map_err(|error| error.to_string())?;
    let path = registry.root();
    let free = free_bytes(path).map_or(String::new(), |free| format!(", {:.1} GB free", free as f64 / 1e9));
    Ok(format!("{} can be written{free}", shown(path)))
}
