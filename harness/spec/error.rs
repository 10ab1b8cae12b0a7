//! Errors in a spec, and their messages.

use serde_yaml::Location;

/// Why a spec was refused. The message says in one line what is wrong, where, and what is allowed.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum SpecError {
    /// The file could not be read as text.
    #[error("{path}: {message}")]
    Unreadable {
        /// Path of the file.
        path: String,
        /// Why it could not be read.
        message: String,
    },
    /// A value or a key in the file is wrong.
    #[error("{path}:{line}:{column}: {message}")]
    Invalid {
        /// Path of the file.
        path: String,
        /// Line of the fault, counted from 1.
        line: u64,
        /// Column of the fault, counted from 1.
        column: u64,
        /// What is wrong, and what is allowed.
        message: String,
    },
    /// No file has the given name, and no file that is part of the program.
    #[error("{message}")]
    NoFile {
        /// The unknown name, and the names that exist.
        message: String,
    },
    /// No world has the given name.
    #[error("{message}")]
    NoWorld {
        /// The unknown name, and the names that exist.
        message: String,
    },
    /// An override is wrong.
    #[error("override '{text}': {message}")]
    Override {
        /// The override as it was given, shortened.
        text: String,
        /// What is wrong, and what is allowed.
        message: String,
    },
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
    pub(crate) const START: Self = Self::File { line: 1, column: 1 };

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

    /// Adds `what` was done to the spec before the problem appeared. A problem in an override says so already.
    pub fn after(mut self, what: &str) -> Self {
        if matches!(self.origin, Origin::File { .. }) {
            self.message = format!("{} (after {what})", self.message);
        }
        self
    }
}
