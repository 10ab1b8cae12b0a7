//! What can be wrong with a spec, and how it is said.

use serde_yaml::Location;

/// Why a spec was refused: one message that says what, where, and what is allowed.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum SpecError {
    /// The file could not be read as text.
    #[error("{path}: {message}")]
    Unreadable { path: String, message: String },
    /// Something in the file, at a line and a column counted from 1.
    #[error("{path}:{line}:{column}: {message}")]
    Invalid { path: String, line: u64, column: u64, message: String },
    /// A name that is no world's.
    #[error("{message}")]
    NoWorld { message: String },
    /// Something in an override.
    #[error("override '{text}': {message}")]
    Override { text: String, message: String },
}

/// Where a value was written.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) enum Origin {
    /// At a line and a column of the file, counted from 1.
    File { line: u64, column: u64 },
    /// In this override, as it was given.
    Override(String),
}

impl Origin {
    /// The beginning of the file.
    pub const START: Self = Self::File { line: 1, column: 1 };

    /// A parser's location; where the parser knows none, the beginning of the file.
    pub fn at(location: Location) -> Self {
        if location == Location::UNKNOWN {
            return Self::START;
        }
        Self::File { line: location.line(), column: location.column() }
    }
}

/// A fault and where it is, before the file's name is known.
#[derive(Debug)]
pub(super) struct Problem {
    pub origin: Origin,
    pub message: String,
}

impl Problem {
    pub fn new(origin: &Origin, message: impl Into<String>) -> Self {
        Self { origin: origin.clone(), message: message.into() }
    }

    pub fn in_file(self, path: &str) -> SpecError {
        let message = self.message;
        match self.origin {
            Origin::File { line, column } => SpecError::Invalid { path: path.into(), line, column, message },
            Origin::Override(text) => SpecError::Override { text, message },
        }
    }

    /// Adds what was done to the file before it had this problem, unless the origin says so itself.
    pub fn after(mut self, what: &str) -> Self {
        if matches!(self.origin, Origin::File { .. }) {
            self.message = format!("{} (after {what})", self.message);
        }
        self
    }
}
