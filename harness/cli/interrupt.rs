//! SIGINT, SIGTERM and SIGHUP: the first asks the work to stop at its next step, and a SIGINT after it ends the process
//! at once.

use signal_hook::consts::{SIGHUP, SIGINT, SIGTERM};
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
    for signal in [SIGINT, SIGTERM, SIGHUP] {
        // `nohup` has the process ignore that its terminal is gone.
        if signal == SIGHUP && is_ignored(signal) {
            continue;
        }
        flag::register(signal, asked.clone())?;
        flag::register_usize(signal, SIGNAL.clone(), signal as usize)?;
    }
    Ok(())
}

/// Whether a signal does nothing to this process.
fn is_ignored(signal: i32) -> bool {
    // SAFETY: asks for the signal's action and changes nothing; all zeros are a valid action.
    unsafe {
        let mut action: libc::sigaction = std::mem::zeroed();
        libc::sigaction(signal, std::ptr::null(), &mut action) == 0 && action.sa_sigaction == libc::SIG_IGN
    }
}

/// Whether the work should stop.
pub fn requested() -> bool {
    SIGNAL.load(Ordering::Relaxed) != 0
}

/// Name and exit code of the signal that asked the work to stop.
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

/// As shells report a process that a signal ended.
fn exit_code(signal: i32) -> i32 {
    128 + signal
}
