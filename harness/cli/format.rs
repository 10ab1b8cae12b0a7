//! The formats in which commands print tables, and files that they write instead.

use super::sheet::Style;
use super::table::{Grid, shown, width};
use super::{DONE, usage};
use anyhow::Result;
use clap::{Args, ValueEnum};
use harness::catalog::{TableFormat, save};
use harness::numbers::counted;
use polars::prelude::DataFrame;
use std::path::PathBuf;
use std::process::ExitCode;

/// Where a command writes its table, and in which format.
#[derive(Args)]
pub struct Destination {
    /// Print the table in this format [default: text]
    #[arg(long, value_name = "FORMAT")]
    format: Option<Format>,
    /// Write the table to a file instead, with all digits: .parquet, .csv or .json
    #[arg(long, short, value_name = "FILE")]
    output: Option<PathBuf>,
}

/// A format of tables on the standard output.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
enum Format {
    /// For the terminal, with rounded numbers
    Text,
    /// A pipe table with rounded numbers
    Markdown,
    /// A tabular with rounded numbers, for booktabs
    Latex,
    /// All rows and digits, for programs
    Csv,
    /// All rows and digits, as an array of objects
    Json,
}

/// What becomes of a table.
pub enum Form {
    /// It is printed for people.
    Page(Style),
    /// It is printed or written for programs.
    Data(Data),
}

/// A table for programs.
pub enum Data {
    /// On the standard output.
    Printed(TableFormat),
    /// In a file, whose ending is the format.
    File(PathBuf),
}

impl Destination {
    /// What becomes of the table.
    ///
    /// # Errors
    /// When there is a format and a file.
    pub fn form(&self) -> Result<Form> {
        Ok(match (self.format, self.output.clone()) {
            (Some(_), Some(path)) => {
                return Err(usage(format!(
                    "--format is the format of the standard output, and the ending of '{}' that of the file; leave out \
                     --format or --output",
                    path.display()
                )));
            }
            (None, Some(path)) => Form::Data(Data::File(path)),
            (None | Some(Format::Text), None) => Form::Page(Style::Text),
            (Some(Format::Markdown), None) => Form::Page(Style::Markdown),
            (Some(Format::Latex), None) => Form::Page(Style::Latex),
            (Some(Format::Csv), None) => Form::Data(Data::Printed(TableFormat::Csv)),
            (Some(Format::Json), None) => Form::Data(Data::Printed(TableFormat::Json)),
        })
    }
}

impl Data {
    /// Prints the table, or writes it to the file and prints the number of its rows, which are called `noun`. Tells
    /// what the format loses.
    pub fn write(self, table: &mut DataFrame, noun: &str) -> Result<ExitCode> {
        let format = match &self {
            Self::Printed(format) => *format,
            Self::File(path) => TableFormat::of(path)?,
        };
        match self {
            Self::Printed(_) => {
                if let Some(column) = format.column_of_bytes(table) {
                    return Err(usage(format!(
                        "the column '{column}' holds bytes, which CSV and JSON can't hold; leave it out, or write Parquet \
                         with --output FILE.parquet"
                    )));
                }
                let mut text = Vec::new();
                format.write(table, &mut text)?;
                println!("{}", String::from_utf8_lossy(&text).trim_end_matches('\n'));
            }
            Self::File(path) => {
                save(table, &path)?;
                println!("{} in {}", counted(table.height(), noun), shown(&path));
            }
        }
        if let Some(loss) = format.loss(table)? {
            eprintln!("{loss}");
        }
        Ok(ExitCode::from(DONE))
    }
}

/// Prints all rows of a grid for people.
pub fn print_page(grid: Grid, style: Style) {
    match style {
        Style::Text => println!("{}", grid.text(width())),
        Style::Markdown => print!("{}", grid.markdown()),
        Style::Latex => print!("{}", grid.latex()),
    }
}
