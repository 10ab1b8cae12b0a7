//! Printing that does not panic. The macros `print!`, `println!` and `eprintln!` of this module replace those of the
//! standard library, which panic if a stream is full or closed.
//!
//! All text is UTF-8, except on a terminal whose locale has another encoding: there it is ASCII.

use std::borrow::Cow;
use std::fmt::Arguments;
use std::io::{self, ErrorKind, IsTerminal, Write};
use std::sync::{LazyLock, Mutex, PoisonError};

macro_rules! print {
    ($($text:tt)*) => { $crate::cli::output::out(format_args!($($text)*)) };
}

macro_rules! println {
    () => { $crate::cli::output::out(format_args!("\n")) };
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
        let written = match io::stdout().is_terminal() {
            true => out.write_all(encoded(&text.to_string()).as_bytes()),
            false => out.write_fmt(text),
        };
        *failure = written.and_then(|()| out.flush()).err();
    }
}

/// Writes to the standard error. An error is ignored, because it could not be reported anywhere.
pub fn tell(text: Arguments) {
    let _ = match io::stderr().is_terminal() {
        true => io::stderr().write_all(encoded(&text.to_string()).as_bytes()),
        false => io::stderr().write_fmt(text),
    };
}

/// Whether the user's locale encodes text as UTF-8.
pub static IS_UTF8: LazyLock<bool> = LazyLock::new(|| {
    let set = |name: &&str| std::env::var_os(name).is_some_and(|value| !value.is_empty());
    let locale = ["LC_ALL", "LC_CTYPE", "LANG"].iter().find(|name| set(name)).and_then(std::env::var_os);
    let locale = locale.unwrap_or_default().to_string_lossy().to_lowercase();
    locale.contains("utf-8") || locale.contains("utf8")
});

/// A text as the terminal can show it.
pub fn encoded(text: &str) -> Cow<'_, str> {
    if *IS_UTF8 || text.is_ascii() {
        return text.into();
    }
    let mut ascii = String::new();
    for character in text.chars() {
        match character {
            '─' => ascii.push('-'),
            '═' => ascii.push('='),
            '↑' => ascii.push('^'),
            '↓' => ascii.push('v'),
            '±' => ascii.push_str("+-"),
            '…' => ascii.push_str("..."),
            '¶' => ascii.push('#'),
            _ if character.is_ascii() => ascii.push(character),
            _ => ascii.push('?'),
        }
    }
    ascii.into()
}

/// Takes the error of the standard output, if one occurred since the last call. A closed pipe is no error, because its
/// reader has read what it wanted.
pub fn lost() -> Option<String> {
    let error = FAILURE.lock().unwrap_or_else(PoisonError::into_inner).take()?;
    let is_loss = error.kind() != ErrorKind::BrokenPipe;
    is_loss.then(|| format!("the standard output can't be written: {error}"))
}
