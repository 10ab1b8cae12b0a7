//! Command lines as text.

use std::path::Path;

/// A path as one word of a command, quoted for a POSIX shell where needed. A path that begins with `-`, which would
/// otherwise be an option, begins with `./`.
pub fn path_word(path: &Path) -> String {
    let text = path.to_string_lossy();
    let place = if text.starts_with('-') { "./" } else { "" };
    quoted([format!("{place}{text}").as_str()])
}

/// Joins words with spaces, each quoted for a POSIX shell where needed.
pub fn quoted<'a>(words: impl IntoIterator<Item = &'a str>) -> String {
    let quote = |word: &'a str| match shlex::try_quote(word) {
        Ok(quoted) => quoted.into_owned(),
        // Only a null byte can't be quoted, and a program's arguments never contain one.
        Err(_) => word.to_owned(),
    };
    words.into_iter().map(quote).collect::<Vec<_>>().join(" ")
}
