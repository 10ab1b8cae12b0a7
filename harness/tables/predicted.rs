//! Predictions that another program has written to a file.

use super::{TableError, unreadable};
use harness_spec::Modality;
use polars::prelude::*;
use std::collections::BTreeMap;
use std::fs::File;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::Path;

/// A predicted value, as a row of a file has it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PredictedRow {
    /// The episode of the dataset.
    pub episode: usize,
    /// The predicted sample, counted from 0 within its episode.
    pub sample: usize,
    /// Number of samples from the present to the predicted one.
    pub horizon: usize,
    /// The predicted modality.
    pub modality: Modality,
    /// The element of the modality, counted from 0; of an image, `[row, column, channel]`.
    pub index: usize,
    /// The value in the modality's unit.
    pub value: f32,
}

/// The rows of a file by the modalities that the model got; `None` if it got all inputs.
pub type PredictedRows = BTreeMap<Option<Vec<Modality>>, Vec<PredictedRow>>;

/// Name and meaning of each column of a file of predictions.
pub const PREDICTED_COLUMNS: [(&str, &str); 7] = [
    ("episode", "index of the episode in the dataset, from 0"),
    ("sample", "index of the predicted sample in its episode, from 0"),
    (
        "horizon",
        "number of samples from the present to the predicted one; without this column 1, or 0 for estimates",
    ),
    (
        "given",
        "modalities that the model got, as arm,proprioception; empty, or no such column, if it got all inputs",
    ),
    ("modality", "the predicted modality"),
    (
        "index",
        "element of the modality, from 0; of an image, row by row, and pixel by pixel with its three channels",
    ),
    (
        "value",
        "the predicted value in the modality's unit; of an image, in [0, 1], or in [-1, 1] for a change",
    ),
];

/// The columns that a file need not have.
const OPTIONAL: [&str; 2] = ["horizon", "given"];

/// Reads a file of predictions: Parquet, or CSV with a line of names if its name ends in `.csv`. Its columns are
/// [`PREDICTED_COLUMNS`], in any order. Without the column `horizon`, all rows are `nearest` samples ahead.
///
/// # Errors
/// When the file can't be read, it lacks a column or has another one, or a value has the wrong type. The reason names
/// the column and the row, counted from 1.
pub fn read_predicted(path: &Path, nearest: usize) -> Result<PredictedRows, TableError> {
    // Polars panics at some types that it was compiled without.
    let table = catch_unwind(AssertUnwindSafe(|| read(path)));
    let unknown =
        || unreadable(path, "it has columns of types that are not supported; write integers and floats");
    let table =
        table.map_err(|_| unknown())?.map_err(|error| unreadable(path, first_line(&error.to_string())))?;
    rows(&table, nearest).map_err(|reason| unreadable(path, reason))
}

fn read(path: &Path) -> PolarsResult<DataFrame> {
    let file = File::open(path)?;
    let is_csv = path.extension().is_some_and(|ending| ending.eq_ignore_ascii_case("csv"));
    match is_csv {
        true => CsvReadOptions::default()
            .with_infer_schema_length(None)
            .into_reader_with_file_handle(file)
            .finish(),
        false => ParquetReader::new(file).finish().map_err(|error| {
            let is_parquet = path.extension().is_some_and(|ending| ending.eq_ignore_ascii_case("parquet"));
            let hint = || "it is no Parquet file; the name of a CSV file must end in .csv".into();
            if is_parquet { error } else { PolarsError::ComputeError(hint()) }
        }),
    }
}

fn first_line(text: &str) -> &str {
    text.lines().next().unwrap_or_default()
}

fn rows(table: &DataFrame, nearest: usize) -> Result<PredictedRows, String> {
    let names: Vec<&str> = PREDICTED_COLUMNS.iter().map(|(name, _)| *name).collect();
    let found: Vec<&str> = table.get_column_names().into_iter().map(|name| name.as_str()).collect();
    let allowed = || format!("the columns must be {}", names.join(", "));
    if let Some(other) = found.iter().find(|name| !names.contains(name)) {
        return Err(format!("it has a column '{other}'; {}", allowed()));
    }
    if let Some(missing) = names.iter().find(|name| !found.contains(name) && !OPTIONAL.contains(name)) {
        return Err(format!("it has no column '{missing}'; {}", allowed()));
    }
    if table.height() == 0 {
        return Ok(PredictedRows::new());
    }
    let (episode, sample, index) =
        (numbers(table, "episode")?, numbers(table, "sample")?, numbers(table, "index")?);
    let horizon =
        if found.contains(&"horizon") { numbers(table, "horizon")? } else { vec![nearest; table.height()] };
    let (modality, value) = (modalities(table)?, values(table)?);
    let given = if found.contains(&"given") { given(table)? } else { vec![None; table.height()] };
    let mut rows = PredictedRows::new();
    for (row, given) in given.into_iter().enumerate() {
        rows.entry(given).or_default().push(PredictedRow {
            episode: episode[row],
            sample: sample[row],
            horizon: horizon[row],
            modality: modality[row],
            index: index[row],
            value: value[row],
        });
    }
    Ok(rows)
}

fn column<'a>(table: &'a DataFrame, name: &str) -> Result<&'a Series, String> {
    let column = table.column(name).map_err(|error| error.to_string())?;
    Ok(column.as_materialized_series())
}

/// Refuses a column with a value that is no number of the right kind.
fn check_numbers(column: &Series, kind: &str, is_right: impl Fn(&str) -> bool) -> Result<(), String> {
    let text = |row: usize| column.get(row).map(|value| value.str_value().into_owned()).unwrap_or_default();
    match (0..column.len()).find(|row| !is_right(text(*row).trim())) {
        Some(row) => Err(format!(
            "the column '{}' has '{}' in row {}, must be {kind}",
            column.name(),
            text(row),
            row + 1
        )),
        None => Ok(()),
    }
}

/// Returns a column of whole numbers that are not negative.
fn numbers(table: &DataFrame, name: &str) -> Result<Vec<usize>, String> {
    let column = column(table, name)?;
    if !column.dtype().is_integer() {
        let is_whole = |text: &str| text.parse::<f64>().is_ok_and(|number| number.fract() == 0.0);
        check_numbers(column, "an integer", is_whole)?;
    }
    let cast = column.cast(&DataType::Int64).map_err(|error| error.to_string())?;
    let number = |(row, number): (usize, Option<i64>)| {
        let number = number.ok_or_else(|| format!("the column '{name}' has no number in row {}", row + 1))?;
        usize::try_from(number)
            .map_err(|_| format!("the column '{name}' has {number} in row {}, must be at least 0", row + 1))
    };
    cast.i64().map_err(|error| error.to_string())?.iter().enumerate().map(number).collect()
}

/// Returns the predicted values. Those that are not finite stay as they are, because the judge names their place.
fn values(table: &DataFrame) -> Result<Vec<f32>, String> {
    let column = column(table, "value")?;
    // Polars reads a column with `nan` as text. NumPy writes NaN like this.
    if let Ok(texts) = column.str()
        && let Some(numbers) = texts.iter().map(|text| text?.trim().parse().ok()).collect()
    {
        return Ok(numbers);
    }
    if !column.dtype().is_primitive_numeric() {
        check_numbers(column, "a number", |text| text.parse::<f32>().is_ok())?;
    }
    let cast = column.cast(&DataType::Float32).map_err(|error| error.to_string())?;
    let value = |(row, value): (usize, Option<f32>)| {
        value.ok_or_else(|| format!("the column 'value' has no number in row {}", row + 1))
    };
    cast.f32().map_err(|error| error.to_string())?.iter().enumerate().map(value).collect()
}

/// Returns the texts of a column with the rows in which they are.
fn texts<'a>(table: &'a DataFrame, name: &str) -> Result<Vec<Option<&'a str>>, String> {
    let column = column(table, name)?;
    let wrong = |_| format!("the column '{name}' has the type {}, must be text", column.dtype());
    if column.dtype().is_null() {
        return Ok(vec![None; table.height()]);
    }
    Ok(column.str().map_err(wrong)?.iter().collect())
}

fn modalities(table: &DataFrame) -> Result<Vec<Modality>, String> {
    let of = |(row, name): (usize, Option<&str>)| {
        let name = name.unwrap_or_default();
        Modality::new(name)
            .ok_or_else(|| format!("'{name}' in row {} is not the name of a modality", row + 1))
    };
    texts(table, "modality")?.into_iter().enumerate().map(of).collect()
}

fn given(table: &DataFrame) -> Result<Vec<Option<Vec<Modality>>>, String> {
    let of = |(row, names): (usize, Option<&str>)| {
        let Some(names) = names.filter(|names| !names.is_empty()) else { return Ok(None) };
        let wrong =
            |name: &str| format!("'{name}' in row {} of 'given' is not the name of a modality", row + 1);
        let modality = |name: &str| Modality::new(name.trim()).ok_or_else(|| wrong(name));
        let mut modalities = names.split(',').map(modality).collect::<Result<Vec<_>, _>>()?;
        modalities.sort();
        modalities.dedup();
        Ok(Some(modalities))
    };
    texts(table, "given")?.into_iter().enumerate().map(of).collect()
}
