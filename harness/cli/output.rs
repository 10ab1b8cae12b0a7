//! Printing that does not panic. The macros `print!`, `println!` and `eprintln!` of this module replace those of the
//! standard library, which panic if a stream is full or closed.

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

/// The error of the last write to the standard output. Nothing is printed after it, until [`lost`] takes it.
static FAILURE: Mutex<Option<io::Error>> = Mutex::new(None);

/// Writes to the standard output, and remembers the error if it fails.
pub fn out(text: Arguments) {
    let mut failure = FAILURE.lock().unwrap_or_else(PoisonError::into_inner);
    if failure.is_none() {
        let mut out = io::stdout().lock();
        *failure = out.write_fmt(text).and_then(|()| out.flush()).err();
    }
}

/// Writes to the standard error. An error is ignored, because it could not be reported anywhere.
pub fn tell(text: Arguments) {
    let _ = io::stderr().write_fmt(text);
}

/// Takes the error of the standard output, if one occurred since the last call. A closed pipe is no error, because its
/// reader has read what it wanted.
pub fn lost() -> Option<String> {
    let error = FAILURE.lock().unwrap_or_else(PoisonError::into_inner).take()?;
    let is_loss = error.kind() != ErrorKind::BrokenPipe;
    is_loss.then(|| format!("the standard output can't be written: {error}"))
}
