//! Answers as rows of a type, and as files for other programs.

use super::QueryError;
use harness_shared::files::write_whole;
use harness_shared::numbers::counted;
use polars::prelude::*;
use serde::de::DeserializeOwned;
use std::fs::File;
use std::io::Write;
use std::path::Path;

/// The rows of an answer as values of `T`. The fields of `T` are named after the columns.
pub fn rows<T: DeserializeOwned>(answer: &mut DataFrame) -> Result<Vec<T>, QueryError> {
    let mut json = Vec::new();
    JsonWriter::new(&mut json).with_json_format(JsonFormat::Json).finish(answer).map_err(QueryError::Sql)?;
    serde_json::from_slice(&json).map_err(QueryError::Rows)
}

/// A format of tables for other programs. Numbers have all their digits.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum TableFormat {
    /// Parquet, with the types of the columns.
    Parquet,
    /// Comma-separated values with a line of names. A null is empty, and an empty text is `""`.
    Csv,
    /// An array of objects.
    Json,
}

impl TableFormat {
    /// The format that the ending of a file's name stands for.
    pub fn of(path: &Path) -> Result<Self, QueryError> {
        let ending = path.extension().and_then(|ending| ending.to_str()).unwrap_or_default().to_lowercase();
        match ending.as_str() {
            "parquet" => Ok(Self::Parquet),
            "csv" => Ok(Self::Csv),
            "json" => Ok(Self::Json),
            _ => Err(QueryError::Format(path.to_owned())),
        }
    }

    /// Writes an answer in this format.
    ///
    /// # Errors
    /// When a column of bytes is written as CSV or JSON, or the answer can't be written.
    pub fn write(self, answer: &mut DataFrame, to: impl Write) -> PolarsResult<()> {
        match self {
            Self::Parquet => ParquetWriter::new(to).finish(answer).map(|_| ()),
            Self::Csv => CsvWriter::new(to).finish(answer),
            Self::Json => JsonWriter::new(to).with_json_format(JsonFormat::Json).finish(answer),
        }
    }

    /// The column of bytes that this format can't hold, if there is one.
    pub fn column_of_bytes(self, answer: &DataFrame) -> Option<String> {
        let column = answer.columns().iter().find(|column| *column.dtype() == DataType::Binary)?;
        (self != Self::Parquet).then(|| column.name().to_string())
    }

    /// What this format loses of an answer, in a sentence: JSON has no NaN and no infinity.
    pub fn loss(self, answer: &DataFrame) -> PolarsResult<Option<String>> {
        if self != Self::Json {
            return Ok(None);
        }
        let mut lost = Vec::new();
        for column in answer.columns().iter().filter(|column| column.dtype().is_float()) {
            let finite = column.as_materialized_series().is_finite()?;
            let count = finite.len() - finite.null_count() - finite.sum().unwrap_or(0) as usize;
            if count > 0 {
                lost.push(format!("{} of '{}'", counted(count, "value"), column.name()));
            }
        }
        let sentence =
            format!("NaN and infinity are null in JSON: {}; CSV and Parquet keep them", lost.join(", "));
        Ok((!lost.is_empty()).then_some(sentence))
    }
}

/// Writes an answer as Parquet, CSV or JSON, depending on the ending of the file's name.
///
/// # Errors
/// When the file's name has another ending, a column of bytes is written as CSV or JSON, or the file can't be written.
pub fn save(answer: &mut DataFrame, path: &Path) -> Result<(), QueryError> {
    let format = TableFormat::of(path)?;
    if let Some(column) = format.column_of_bytes(answer) {
        return Err(QueryError::Bytes { path: path.to_owned(), column });
    }
    write_whole(path, |file| format.write(answer, File::create(file)?).map_err(std::io::Error::other))?;
    Ok(())
}
