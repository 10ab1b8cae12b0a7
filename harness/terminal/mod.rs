//! Text and tables for people: in the terminal, in Markdown and in LaTeX.

// This module must come first, because its macros are only visible in the modules after it.
#[macro_use]
pub mod output;

pub mod encoding;
pub mod latex;
pub mod table;
