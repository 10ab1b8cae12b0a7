//! The harness as a Python extension: thin newtypes over the library, and nothing scientific.
//!
//! Every call that takes long lets go of the interpreter's lock. Errors become the Python exception that fits
//! ([`errors`]), and never a panic. Docstrings for users stand in `harness/_harness.pyi`.

mod array;
mod dataset;
mod errors;
mod model;
mod run;
mod simulation;
mod work;

use mimalloc::MiMalloc;
use pyo3::prelude::*;

/// As in the harness's binary: trainings free and allocate the same hundreds of megabytes at every step.
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
    use super::model::Model;
    #[pymodule_export]
    use super::run::{Table, compare, query, run};
    #[pymodule_export]
    use super::simulation::SimulationBatch;

    /// Runs the command line; returns its exit code.
    #[pyfunction]
    fn main(py: Python, arguments: Vec<OsString>) -> u8 {
        cli::prepare_process();
        // SAFETY: called by the `harness` script alone, whose process does nothing else; the signal is as the program
        // would have found it, had it not been started by Python.
        unsafe { libc::signal(libc::SIGINT, libc::SIG_DFL) };
        let code = py.detach(|| cli::main(arguments));
        // An exit code does not tell its number, but what it equals.
        (0..=u8::MAX).find(|number| ExitCode::from(*number) == code).unwrap_or(u8::MAX)
    }
}
