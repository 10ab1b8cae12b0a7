//! Runs long work without the interpreter's lock, on another thread, so that Ctrl-C can interrupt it. Work is refused
//! in a forked process, because a fork has none of its parent's threads.

use pyo3::exceptions::PyRuntimeError;
use pyo3::prelude::*;
use std::any::Any;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::OnceLock;
use std::sync::mpsc::{RecvTimeoutError, channel};
use std::time::Duration;

/// Time between two checks for signals.
const SIGNALS: Duration = Duration::from_millis(50);

/// Does `work` on another thread, without the interpreter's lock, while this thread handles signals. If a signal
/// handler raises an exception (KeyboardInterrupt), `cancel` is called, which must make the work end. The exception is
/// returned after the work has ended.
///
/// # Errors
/// The exception of a signal handler; RuntimeError in a forked process, or if the work panicked.
pub fn interruptible<T: Send>(
    py: Python,
    work: impl FnOnce() -> T + Send,
    cancel: impl Fn() + Sync,
) -> PyResult<T> {
    own_process()?;
    std::thread::scope(|scope| {
        let (done, mut over) = channel();
        let worker = scope.spawn(move || {
            let result = work();
            // Fails if the interpreter is shutting down, because nothing receives then.
            let _ = done.send(());
            result
        });
        let mut raised = None;
        let mut wait = || {
            let over = &mut over;
            py.detach(move || over.recv_timeout(SIGNALS))
        };
        while let Err(RecvTimeoutError::Timeout) = wait() {
            if let Err(exception) = py.check_signals() {
                raised.get_or_insert(exception);
                cancel();
            }
        }
        let result = py.detach(|| worker.join());
        raised.map_or_else(|| result.map_err(panicked), Err)
    })
}

/// Does `work` on this thread, without the interpreter's lock. Signals are not handled, so it is for work of
/// milliseconds.
///
/// # Errors
/// RuntimeError in a forked process, or if the work panicked.
pub fn detached<T: Send>(py: Python, work: impl FnOnce() -> T + Send) -> PyResult<T> {
    own_process()?;
    // Asserting unwind safety is correct, because models and datasets never change.
    py.detach(|| catch_unwind(AssertUnwindSafe(work))).map_err(panicked)
}

/// Converts a panic of the library, which is always a bug, to a RuntimeError.
fn panicked(panic: Box<dyn Any + Send>) -> PyErr {
    let said = panic.downcast_ref::<String>().map(String::as_str);
    let said = said.or(panic.downcast_ref::<&str>().copied()).unwrap_or("no reason given");
    PyRuntimeError::new_err(format!("the harness panicked, which is a fault of its own: {said}"))
}

/// Returns an error in a process that was forked after the harness had begun to work in its parent, because the
/// parent's threads do not exist in it.
fn own_process() -> PyResult<()> {
    static PROCESS: OnceLock<u32> = OnceLock::new();
    belongs_here(*PROCESS.get_or_init(std::process::id), "the harness's threads")
}

/// Returns an error if `what` was made by another process, from which this one was forked.
pub fn belongs_here(process: u32, what: &str) -> PyResult<()> {
    let here = std::process::id();
    if process == here {
        return Ok(());
    }
    Err(PyRuntimeError::new_err(format!(
        "{what} belong to process {process}, from which this process {here} was forked; start processes with \
         'spawn' or 'forkserver', or make it in the process that uses it"
    )))
}
