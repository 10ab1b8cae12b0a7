//! The errors of queries.

use harness_registry::RegistryError;
use harness_shared::files::WriteError;
use harness_sql::SqlError;
use polars::prelude::PolarsError;
use std::path::PathBuf;
use std::sync::Arc;

/// An error in answering a query, or in reading or writing its answer.
#[derive(Debug, thiserror::Error)]
pub enum QueryError {
    /// A table's file is damaged or missing.
    #[error(transparent)]
    Registry(#[from] RegistryError),
    /// Polars failed to compute the answer.
    // Polars adds a plan of many lines.
    #[error("the query can't be answered: {}", .0.to_string().lines().next().unwrap_or_default())]
    Sql(#[source] PolarsError),
    /// The query is wrong or not supported. The message says what to write instead.
    #[error("the query can't be answered: {0}")]
    Refused(String),
    /// The answer's rows can't be converted to the wanted type.
    #[error("the rows of the answer have unexpected types: {0}")]
    Rows(serde_json::Error),
    /// The output file's name has none of the supported endings.
    #[error("can't write to '{}': its name must end in .parquet, .csv or .json", .0.display())]
    Format(PathBuf),
    /// CSV and JSON have no bytes.
    #[error(
        "can't write to '{}': the column '{column}' holds bytes; choose a name that ends in .parquet, or leave the \
         column out",
        path.display()
    )]
    Bytes {
        /// The output file.
        path: PathBuf,
        /// The first column that holds bytes.
        column: String,
    },
    /// The output file can't be written.
    #[error(transparent)]
    Write(#[from] WriteError),
}

impl QueryError {
    /// Whether a file is missing because its run was removed.
    pub(crate) fn is_of_removed_run(&self) -> bool {
        let Self::Registry(RegistryError::File { path, .. }) = self else { return false };
        path.parent().is_some_and(|folder| !folder.exists())
    }
}

impl From<SqlError> for QueryError {
    fn from(error: SqlError) -> Self {
        match error {
            SqlError::Refused(reason) => Self::Refused(reason),
            SqlError::Polars(error) => error.into(),
        }
    }
}

impl From<PolarsError> for QueryError {
    /// Unwraps a registry error that a lazily read table wrapped in a Polars error.
    fn from(error: PolarsError) -> Self {
        let PolarsError::IO { error, msg } = error else { return Self::Sql(error) };
        match Arc::try_unwrap(error).map(std::io::Error::downcast::<RegistryError>) {
            Ok(Ok(error)) => Self::Registry(error),
            Ok(Err(error)) => Self::Sql(PolarsError::IO { error: Arc::new(error), msg }),
            Err(error) => Self::Sql(PolarsError::IO { error, msg }),
        }
    }
}
