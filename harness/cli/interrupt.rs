//! SIGINT and SIGTERM: the first asks the work to stop at its next step, and a SIGINT after it ends the process at once.

use signal_hook::consts::{SIGINT, SIGTERM};
use signal_hook::flag;
use std::io;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::{Arc, LazyLock};

/// The signal that asked the work to stop; 0 before any did.
static SIGNAL: LazyLock<Arc<AtomicUsize>> = LazyLock::new(Arc::default);

/// Turns the signals into a wish to stop; without it they end the process.
pub fn install() -> io::Result<()> {
    let asked = Arc::new(AtomicBool::new(false));
    // Actions run in the order of registration, so the first signal finds `asked` false.
    flag::register_conditional_shutdown(SIGINT, exit_code(SIGINT), asked.clone())?;
    for signal in [SIGINT, SIGTERM] {
        flag::register(signal, asked.clone())?;
        flag::register_usize(signal, SIGNAL.clone(), signal as usize)?;
    }
    Ok(())
}

/// Whether the work should stop.
pub fn requested() -> bool {
    SIGNAL.load(Ordering::Relaxed) != 0
}

/// Name and exit code of the signal that asked the work to stop.
pub fn received() -> Option<(&'static str, u8)> {
    match SIGNAL.load(Ordering::Relaxed) as i32 {
        0 => None,
        SIGTERM => Some(("SIGTERM", exit_code(SIGTERM) as u8)),
        _ => Some(("SIGINT", exit_code(SIGINT) as u8)),
    }
}

/// As shells report a process that a signal ended.
fn exit_code(signal: i32) -> i32 {
    128 + signal
}
