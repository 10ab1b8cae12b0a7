//! The harness as a Python extension module: thin wrappers of the library's types and functions.
//!
//! Long calls release the interpreter's lock. Errors and panics are converted to Python exceptions ([`errors`],
//! [`work`]). The comments on classes and methods are their docstrings. `harness/_harness.pyi` repeats them for editors
//! and for the documentation site, and a test compares both.

mod array;
mod dataset;
mod errors;
mod mapping;
mod model;
mod policy;
mod replay;
mod results;
mod run;
mod simulation;
mod task;
mod work;

use mimalloc::MiMalloc;
use pyo3::prelude::*;

/// The same allocator as in the program, because training frees and allocates hundreds of megabytes in every step.
#[global_allocator]
static ALLOCATOR: MiMalloc = MiMalloc;

#[pymodule]
mod _harness {
    use super::*;
    use harness::cli;
    use std::ffi::OsString;
    use std::process::ExitCode;

    #[pymodule_export]
    use super::dataset::Dataset;
    #[pymodule_export]
    use super::mapping::{read_mapping, recording_notes, reserved_names};
    #[pymodule_export]
    use super::model::{Model, attached, export_onnx, may_have_network, networks};
    #[pymodule_export]
    use super::policy::{PolicyDataset, Recorder};
    #[pymodule_export]
    use super::replay::Replays;
    #[pymodule_export]
    use super::results::{
        add_metric, answer, claims, collect, extract, figures, plot, recorded, report, report_dataset, verify,
    };
    #[pymodule_export]
    use super::run::{Table, query, run};
    #[pymodule_export]
    use super::simulation::SimulationBatch;
    #[pymodule_export]
    use super::task::Task;

    /// Runs the command line; returns its exit code. See [`cli::main`].
    #[pyfunction]
    fn main(py: Python, arguments: Vec<OsString>, program: Vec<String>) -> u8 {
        cli::prepare_process();
        // SAFETY: only the `harness` script calls this function, and its process does nothing else. The call restores
        // the signal's default action, which Python has replaced.
        unsafe { libc::signal(libc::SIGINT, libc::SIG_DFL) };
        let code = py.detach(|| cli::main(arguments, program));
        // `ExitCode` does not return its number, but can be compared.
        (0..=u8::MAX).find(|number| ExitCode::from(*number) == code).unwrap_or(u8::MAX)
    }
}
