//! Printing that does not panic. The macros `print!`, `println!` and `eprintln!` of this module replace those of the
//! standard library, which panic if a stream is full or closed.
//!
//! All text is UTF-8, except on a terminal whose locale has another encoding: there it is ASCII.

use crate::terminal::encoding::encoded;
use crate::terminal::table::fitted;
use std::fmt::Arguments;
use std::io::{self, ErrorKind, IsTerminal, Write};
use std::sync::{Mutex, PoisonError};
use terminal_size::terminal_size_of;

/// Prints text to the standard output; see the module [`output`](crate::terminal::output).
macro_rules! print {
    ($($text:tt)*) => { $crate::terminal::output::out(format_args!($($text)*)) };
}

/// Prints a line to the standard output; see the module [`output`](crate::terminal::output).
macro_rules! println {
    () => { $crate::terminal::output::out(format_args!("\n")) };
    ($($text:tt)*) => { $crate::terminal::output::out(format_args!("{}\n", format_args!($($text)*))) };
}

/// Prints a line to the standard error; see the module [`output`](crate::terminal::output).
macro_rules! eprintln {
    ($($text:tt)*) => { $crate::terminal::output::tell(format_args!($($text)*)) };
}

/// The error of the last write to the standard output. Nothing is printed after it, until [`lost`] takes it.
static FAILURE: Mutex<Option<io::Error>> = Mutex::new(None);

/// Writes to the standard output, and remembers the error if it fails.
pub fn out(text: Arguments) {
    let mut failure = FAILURE.lock().unwrap_or_else(PoisonError::into_inner);
    if failure.is_none() {
        let mut out = io::stdout().lock();
        let written = match io::stdout().is_terminal() {
            true => out.write_all(encoded(&text.to_string()).as_bytes()),
            false => out.write_fmt(text),
        };
        *failure = written.and_then(|()| out.flush()).err();
    }
}

/// Writes a line of text to the standard error. On a terminal, it is broken between words where the terminal ends. An
/// error is ignored, because it could not be reported anywhere.
pub fn tell(text: Arguments) {
    let width = terminal_size_of(io::stderr()).map(|(width, _)| width.0);
    let line = fitted(&text.to_string(), width) + "\n";
    let line = if io::stderr().is_terminal() { encoded(&line) } else { line.as_str().into() };
    let _ = io::stderr().write_all(line.as_bytes());
}

/// Whether nothing more is printed, because the standard output is full or closed.
pub fn is_closed() -> bool {
    FAILURE.lock().unwrap_or_else(PoisonError::into_inner).is_some()
}

/// Takes the error of the standard output, if one occurred since the last call. A closed pipe is no error, because its
/// reader has read what it wanted.
pub fn lost() -> Option<String> {
    let error = FAILURE.lock().unwrap_or_else(PoisonError::into_inner).take()?;
    let is_loss = error.kind() != ErrorKind::BrokenPipe;
    is_loss.then(|| format!("the standard output can't be written: {error}"))
}
