//! What the program prints. A standard output or error that is full or closed ends no work: instead of the standard
//! library's, which panic, this room's `print!`, `println!` and `eprintln!` are those below.

use std::fmt::Arguments;
use std::io::{self, ErrorKind, Write};
use std::sync::{Mutex, PoisonError};

macro_rules! print {
    ($($text:tt)*) => { $crate::cli::output::out(format_args!($($text)*)) };
}

macro_rules! println {
    ($($text:tt)*) => { $crate::cli::output::out(format_args!("{}\n", format_args!($($text)*))) };
}

macro_rules! eprintln {
    ($($text:tt)*) => { $crate::cli::output::tell(format_args!("{}\n", format_args!($($text)*))) };
}

/// Why the standard output could not be written; until somebody asks, nothing more is printed.
static FAILURE: Mutex<Option<io::Error>> = Mutex::new(None);

/// Writes to the standard output.
pub fn out(text: Arguments) {
    let mut failure = FAILURE.lock().unwrap_or_else(PoisonError::into_inner);
    if failure.is_none() {
        let mut out = io::stdout().lock();
        *failure = out.write_fmt(text).and_then(|()| out.flush()).err();
    }
}

/// Writes to the standard error; where that can't be done, there is no one to tell.
pub fn tell(text: Arguments) {
    let _ = io::stderr().write_fmt(text);
}

/// Why something that was printed got lost, once. A reader that went away has had what it wanted.
pub fn lost() -> Option<String> {
    let error = FAILURE.lock().unwrap_or_else(PoisonError::into_inner).take()?;
    let is_loss = error.kind() != ErrorKind::BrokenPipe;
    is_loss.then(|| format!("the standard output can't be written: {error}"))
}
