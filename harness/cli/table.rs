//! Tables on the terminal.

use comfy_table::{CellAlignment, ContentArrangement, Table, presets};
use harness::numbers::rounded;
use polars::prelude::{AnyValue, DataFrame};
use std::path::Path;

/// The maximum number of rows that are printed.
const MOST_ROWS: usize = 200;

/// Prints a table. Numbers are aligned to the right and rounded to four digits.
pub fn print(table: &DataFrame) {
    let mut out = Table::new();
    out.load_preset(presets::UTF8_BORDERS_ONLY);
    out.set_header(table.get_column_names().into_iter().map(|name| name.to_string()));
    let rows = table.height().min(MOST_ROWS);
    for row in 0..rows {
        out.add_row(table.columns().iter().map(|column| column.get(row).map_or(String::new(), cell)));
    }
    for (index, column) in table.columns().iter().enumerate() {
        if column.dtype().is_numeric()
            && let Some(column) = out.column_mut(index)
        {
            column.set_cell_alignment(CellAlignment::Right);
        }
    }
    println!("{out}");
    if rows < table.height() {
        println!("{} more rows; write all of them with --output FILE.csv", table.height() - rows);
    }
}

/// The width of a line in characters if the output is no terminal.
const LINE: u16 = 160;

/// A table with a line between rows. Its cells are wrapped so that it fits the terminal.
pub fn wrapped<const N: usize>(header: [&str; N], rows: Vec<[String; N]>) -> Table {
    let mut out = Table::new();
    out.load_preset(presets::UTF8_HORIZONTAL_ONLY).set_content_arrangement(ContentArrangement::Dynamic);
    if !out.is_tty() {
        out.set_width(LINE);
    }
    out.set_header(header).add_rows(rows);
    out
}

fn cell(value: AnyValue) -> String {
    match value {
        AnyValue::Null => "-".into(),
        AnyValue::String(text) => text.into(),
        AnyValue::StringOwned(text) => text.to_string(),
        AnyValue::Float64(value) => rounded(value),
        AnyValue::Float32(value) => rounded(value.into()),
        AnyValue::Binary(bytes) => format!("{} bytes", bytes.len()),
        other => other.to_string(),
    }
}

/// A path for messages. It is absolute if the current folder is known.
pub fn shown(path: &Path) -> String {
    std::path::absolute(path).unwrap_or_else(|_| path.to_owned()).display().to_string()
}
