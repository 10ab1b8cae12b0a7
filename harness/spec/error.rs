//! Errors in a spec, and their messages.

use crate::yaml::{Place, Problem};

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

impl SpecError {
    /// Returns the error of a problem in the file `path`.
    pub(super) fn of(problem: Problem, path: &str) -> Self {
        let message = problem.message;
        match problem.place {
            Place::File { line, column } => Self::Invalid { path: path.into(), line, column, message },
            Place::Base { path, line, column } => {
                Self::Invalid { path: path.to_string(), line, column, message }
            }
            Place::Override(text) => Self::Override { text, message },
        }
    }
}
