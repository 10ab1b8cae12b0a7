//! YAML text as a tree in which every value has its place, and checks of the tree against a JSON schema.
//!
//! What a file means is left to others: a spec, a world.

mod check;
mod parse;

pub use check::{
    Hints, allow_single_values, check_against, check_part, choices, is_like, join, key_pattern, list_single,
    no_name, not_known, properties, property, resolve, takes_one_item, types, unknown,
};
pub use parse::{Entry, Node, Value, parse, shorten};

use serde_yaml::Location;
use std::sync::Arc;

/// Regular expression of the names that a user chooses.
pub const NAME: &str = "^[a-z][a-z0-9_]{0,63}$";

/// Returns whether a text matches [`NAME`]: 1 to 64 lower-case letters, digits and `_`, of which the first is a letter.
pub fn is_name(text: &str) -> bool {
    (1..=64).contains(&text.len())
        && text.starts_with(|c: char| c.is_ascii_lowercase())
        && text.chars().all(|c| c.is_ascii_lowercase() || c.is_ascii_digit() || c == '_')
}

/// Where a value was written.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Place {
    /// At a line and a column of the file, counted from 1.
    File {
        /// The line.
        line: u64,
        /// The column.
        column: u64,
    },
    /// At a line and a column of another file, on which the file builds.
    Base {
        /// The path of the other file.
        path: Arc<str>,
        /// The line.
        line: u64,
        /// The column.
        column: u64,
    },
    /// In this override, as it was given.
    Override(String),
}

impl Place {
    /// The beginning of the file.
    pub const START: Self = Self::File { line: 1, column: 1 };

    /// Returns a parser's location, or the beginning of the file if the location is unknown.
    pub fn at(location: Location) -> Self {
        if location == Location::UNKNOWN {
            return Self::START;
        }
        Self::File { line: location.line(), column: location.column() }
    }
}

/// A fault and where it is, before the file's name is known.
#[derive(Debug)]
pub struct Problem {
    /// Where the fault is.
    pub place: Place,
    /// What is wrong, and what is allowed.
    pub message: String,
}

impl Problem {
    /// Creates the problem of a value at a place.
    pub fn new(place: &Place, message: impl Into<String>) -> Self {
        Self { place: place.clone(), message: message.into() }
    }

    /// Says which items of lists have the problem, the outer one first, counted from 1. A place in a file says so already.
    #[must_use]
    pub fn in_items(mut self, items: &[usize]) -> Self {
        if matches!(self.place, Place::Override(_)) {
            let items: String = items.iter().map(|item| format!("item {item}: ")).collect();
            self.message.insert_str(0, &items);
        }
        self
    }

    /// Adds `what` was done to the file before the problem appeared. A problem in an override says so already.
    #[must_use]
    pub fn after(mut self, what: &str) -> Self {
        if !matches!(self.place, Place::Override(_)) {
            self.message = format!("{} (after {what})", self.message);
        }
        self
    }
}
