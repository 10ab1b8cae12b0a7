//! Text for terminals whose locale has another encoding than UTF-8.

use std::borrow::Cow;
use std::sync::LazyLock;

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
