//! Handling of SIGINT, SIGTERM and SIGHUP. The first signal asks the work to stop at its next step. A SIGINT after it
//! ends the process at once.

use signal_hook::consts::{SIGHUP, SIGINT, SIGTERM};
use signal_hook::flag;
use std::io;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::{Arc, LazyLock};

/// The last signal that was received, or 0.
static SIGNAL: LazyLock<Arc<AtomicUsize>> = LazyLock::new(Arc::default);

/// Installs the handlers. Before, a signal ends the process.
pub fn install() -> io::Result<()> {
    let asked = Arc::new(AtomicBool::new(false));
    // Actions run in the order of registration, so the first signal finds `asked` false.
    flag::register_conditional_shutdown(SIGINT, exit_code(SIGINT), asked.clone())?;
    for signal in [SIGINT, SIGTERM, SIGHUP] {
        // `nohup` makes the process ignore SIGHUP, which must stay so.
        if signal == SIGHUP && is_ignored(signal) {
            continue;
        }
        flag::register(signal, asked.clone())?;
        flag::register_usize(signal, SIGNAL.clone(), signal as usize)?;
    }
    Ok(())
}

/// Whether this process ignores a signal.
fn is_ignored(signal: i32) -> bool {
    // SAFETY: `sigaction` only asks for the signal's action, and an action of zeros is valid.
    unsafe {
        let mut action: libc::sigaction = std::mem::zeroed();
        libc::sigaction(signal, std::ptr::null(), &mut action) == 0 && action.sa_sigaction == libc::SIG_IGN
    }
}

/// Whether a signal asked the work to stop.
pub fn requested() -> bool {
    SIGNAL.load(Ordering::Relaxed) != 0
}

/// The name of the signal that asked the work to stop, and the process's exit code for it.
pub fn received() -> Option<(&'static str, u8)> {
    let signal = SIGNAL.load(Ordering::Relaxed) as i32;
    let name = match signal {
        0 => return None,
        SIGTERM => "SIGTERM",
        SIGHUP => "SIGHUP",
        _ => "SIGINT",
    };
    Some((name, exit_code(signal) as u8))
}

/// The exit code with which shells report a process that a signal ended.
fn exit_code(signal: i32) -> i32 {
    128 + signal
}
