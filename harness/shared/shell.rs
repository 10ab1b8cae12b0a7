//! Command lines as text.

/// Joins words with spaces, each quoted for a POSIX shell where needed.
pub fn quoted<'a>(words: impl IntoIterator<Item = &'a str>) -> String {
    let quote = |word: &'a str| match shlex::try_quote(word) {
        Ok(quoted) => quoted.into_owned(),
        // Only a null byte can't be quoted, and a program's arguments never contain one.
        Err(_) => word.to_owned(),
    };
    words.into_iter().map(quote).collect::<Vec<_>>().join(" ")
}
