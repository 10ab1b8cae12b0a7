//! Long work beside the interpreter: on a thread of its own, so that Ctrl-C is heard, and never in a forked copy of a
//! process whose threads are gone.

use pyo3::exceptions::PyRuntimeError;
use pyo3::prelude::*;
use std::any::Any;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::OnceLock;
use std::sync::mpsc::{RecvTimeoutError, channel};
use std::time::Duration;

/// Time between two looks at whether a signal came.
const SIGNALS: Duration = Duration::from_millis(50);

/// Does `work` on another thread, without the interpreter's lock, while this one handles signals. What a handler
/// raises (KeyboardInterrupt) makes `cancel` tell the work to end, and is raised when it has.
///
/// # Errors
/// What a signal's handler raised; RuntimeError in a forked process, or where the work panicked.
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
            // Nobody listens any more where the interpreter is ending.
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

/// Does `work` on this thread, without the interpreter's lock: for what takes milliseconds.
///
/// # Errors
/// RuntimeError in a forked process, or where the work panicked.
pub fn detached<T: Send>(py: Python, work: impl FnOnce() -> T + Send) -> PyResult<T> {
    own_process()?;
    // What panicked is not looked at again: models and datasets never change.
    py.detach(|| catch_unwind(AssertUnwindSafe(work))).map_err(panicked)
}

/// A panic of the library, which is never meant to happen.
fn panicked(panic: Box<dyn Any + Send>) -> PyErr {
    let said = panic.downcast_ref::<String>().map(String::as_str);
    let said = said.or(panic.downcast_ref::<&str>().copied()).unwrap_or("no reason given");
    PyRuntimeError::new_err(format!("the harness panicked, which is a fault of its own: {said}"))
}

/// Refuses a process that was forked after the harness had begun to work in its parent: threads that it waits for
/// would not be there.
fn own_process() -> PyResult<()> {
    static PROCESS: OnceLock<u32> = OnceLock::new();
    belongs_here(*PROCESS.get_or_init(std::process::id), "the harness's threads")
}

/// Refuses what another process made, from which this one was forked.
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
