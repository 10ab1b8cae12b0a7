//! Converts errors of the library to Python exceptions, whose messages name all causes in one line.

use harness::analysis::AnalysisError;
use harness::catalog::QueryError;
use harness::dataset::DatasetError;
use harness::experiment::{ExperimentError, ModelError, SubmissionError, describe};
use harness::figures::FigureError;
use harness::learning::LearningError;
use harness::registry::RegistryError;
use harness::simulation::SimulationError;
use harness::spec::SpecError;
use pyo3::PyErr;
use pyo3::exceptions::{PyFileNotFoundError, PyKeyError, PyOSError, PyRuntimeError, PyValueError};
use std::path::Path;

/// An error that can be converted to a Python exception.
pub trait Raise: std::error::Error + Sized {
    /// Returns the exception, with the message of [`describe`].
    fn raise(self) -> PyErr;

    /// Returns a ValueError with the message of [`describe`].
    fn value_error(self) -> PyErr {
        PyValueError::new_err(describe(&self))
    }

    /// Returns a RuntimeError with the message of [`describe`].
    fn runtime_error(self) -> PyErr {
        PyRuntimeError::new_err(describe(&self))
    }
}

impl Raise for SpecError {
    fn raise(self) -> PyErr {
        match &self {
            Self::Unreadable { path, .. } if !Path::new(path).exists() => {
                PyFileNotFoundError::new_err(self.to_string())
            }
            Self::NoFile { .. } => PyFileNotFoundError::new_err(self.to_string()),
            _ => self.value_error(),
        }
    }
}

impl Raise for SimulationError {
    fn raise(self) -> PyErr {
        match self {
            Self::World(error) => error.raise(),
            Self::Compile { .. }
            | Self::Missing { .. }
            | Self::Unsuitable { .. }
            | Self::Spec { .. }
            | Self::Setpoint { .. }
            | Self::Argument(_) => self.value_error(),
            _ => self.runtime_error(),
        }
    }
}

impl Raise for DatasetError {
    fn raise(self) -> PyErr {
        self.runtime_error()
    }
}

impl Raise for RegistryError {
    fn raise(self) -> PyErr {
        match self {
            Self::Unknown(_) => PyKeyError::new_err(self.to_string()),
            // On the command line it is an option.
            Self::NoResults { root, problem } => PyFileNotFoundError::new_err(format!(
                "there are no results in {}: {problem}; the argument `results` names the folder that runs were \
                 written to",
                root.display()
            )),
            _ => self.runtime_error(),
        }
    }
}

impl Raise for QueryError {
    fn raise(self) -> PyErr {
        match self {
            Self::Registry(error) => error.raise(),
            Self::Sql(_) | Self::Refused(_) => self.value_error(),
            _ => self.runtime_error(),
        }
    }
}

impl Raise for AnalysisError {
    fn raise(self) -> PyErr {
        match self {
            Self::Query(error) => error.raise(),
            Self::Nothing(_)
            | Self::NothingFinished { .. }
            | Self::NothingChosen { .. }
            | Self::Outdated { .. } => PyKeyError::new_err(self.to_string()),
            _ => self.value_error(),
        }
    }
}

impl Raise for FigureError {
    fn raise(self) -> PyErr {
        match self {
            Self::Ambiguous { .. } | Self::TooMany { .. } | Self::SeveralMetrics(_) => self.value_error(),
            Self::Analysis(error) => error.raise(),
            Self::Query(error) => error.raise(),
            Self::Write(_) => PyOSError::new_err(describe(&self)),
            _ => self.runtime_error(),
        }
    }
}

impl Raise for ExperimentError {
    fn raise(self) -> PyErr {
        match self {
            Self::Simulation(error) => error.raise(),
            Self::Registry(error) => error.raise(),
            Self::NoTraining
            | Self::Dataset(DatasetError::Unsuitable(_))
            | Self::Learning(LearningError::Device { .. }) => self.value_error(),
            Self::Submission(SubmissionError::Held { .. }) => self.runtime_error(),
            Self::Submission(_) => self.value_error(),
            _ => self.runtime_error(),
        }
    }
}

impl Raise for ModelError {
    fn raise(self) -> PyErr {
        match self {
            Self::Registry(error) => error.raise(),
            Self::NoNetwork(_) => PyFileNotFoundError::new_err(self.to_string()),
            Self::Lacks(_) => PyKeyError::new_err(self.to_string()),
            Self::Shape(_) => self.value_error(),
            _ => self.runtime_error(),
        }
    }
}
