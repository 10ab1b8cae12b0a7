//! Tables and texts that fit the terminal.
//!
//! A table that is too wide for the terminal is wrapped between words. If this is not enough, each row becomes a block
//! with a line for each column. If the output is no terminal, tables are as wide as their contents, so that the output
//! of a command does not depend on where it is called.

use super::output::{IS_UTF8, encoded};
use comfy_table::{CellAlignment, ColumnConstraint, ContentArrangement, Table, Width};
use harness::numbers::rounded;
use polars::prelude::{AnyValue, DataFrame};
use std::path::Path;
use terminal_size::terminal_size_of;
use textwrap::core::display_width;
use textwrap::{Options, WordSplitter};

/// The maximum number of rows that are printed.
const MOST_ROWS: usize = 200;
/// Spaces between two columns.
const GAP: u16 = 2;
/// The least width of a text beside its heading. In narrower terminals it stands below the heading.
const LEAST_TEXT: usize = 24;
/// The width of a line in characters if the output is no terminal and has texts of any length.
pub const LINE: u16 = 160;

/// Lines for the borders of a table, in comfy-table's order: a line below the header.
const PLAIN: &str = "     ─             ";
/// A line between rows too.
const RULED: &str = "     ═   ─         ";

/// The width of the terminal in characters, or `None` if the standard output is no terminal.
pub fn width() -> Option<u16> {
    size().map(|(width, _)| width)
}

/// The width and the height of the terminal in characters, or `None` if the standard output is no terminal.
pub fn size() -> Option<(u16, u16)> {
    terminal_size_of(std::io::stdout()).map(|(width, height)| (width.0, height.0))
}

/// The cells of a table.
#[derive(Default)]
pub struct Grid {
    pub header: Vec<String>,
    pub rows: Vec<Vec<String>>,
    /// Whether the cells of each column are aligned to the right.
    pub right: Vec<bool>,
    /// Whether there is a line between rows.
    pub ruled: bool,
}

impl Grid {
    /// A table of texts.
    pub fn of_texts<const N: usize>(header: [&str; N], rows: Vec<[String; N]>) -> Self {
        Self {
            header: header.map(str::to_owned).to_vec(),
            rows: rows.into_iter().map(Vec::from).collect(),
            right: vec![false; N],
            ruled: false,
        }
    }

    /// The first rows of a table.
    pub fn of_table(table: &DataFrame) -> Self {
        let cells = |row| {
            let values = table.columns().iter().map(move |column| column.get(row));
            values.map(|value| value.map_or(String::new(), cell)).collect()
        };
        Self {
            header: table.get_column_names().into_iter().map(|name| name.to_string()).collect(),
            rows: (0..table.height().min(MOST_ROWS)).map(cells).collect(),
            right: table.columns().iter().map(|column| column.dtype().is_numeric()).collect(),
            ruled: false,
        }
    }

    /// The text of the table, at most `limit` characters wide if that is possible.
    pub fn text(mut self, limit: Option<u16>) -> String {
        // The widths of the columns are those of the text as it is shown.
        if limit.is_some() && !*IS_UTF8 {
            let cells = self.rows.iter_mut().flatten().chain(&mut self.header);
            cells.for_each(|cell| *cell = encoded(cell).into_owned());
        }
        match limit {
            Some(limit) if !self.fits(limit) => self.blocks(limit),
            _ => self.lines(limit),
        }
    }

    /// Whether the table is at most `limit` characters wide if no word is broken.
    pub fn fits(&self, limit: u16) -> bool {
        let width: u32 = self.least_widths().iter().map(|width| u32::from(*width) + u32::from(GAP)).sum();
        width <= u32::from(limit) + u32::from(GAP)
    }

    /// The width of the longest word of each column.
    fn least_widths(&self) -> Vec<u16> {
        let longest = |column: usize| {
            let cells = self.rows.iter().chain([&self.header]).filter_map(|row| row.get(column));
            cells.flat_map(|cell| cell.split_whitespace()).map(display_width).max()
        };
        let widths = (0..self.right.len()).map(|column| longest(column).unwrap_or_default());
        widths.map(|width| u16::try_from(width).unwrap_or(u16::MAX - GAP)).collect()
    }

    fn lines(&self, limit: Option<u16>) -> String {
        let mut out = Table::new();
        out.load_preset(if self.ruled { RULED } else { PLAIN });
        if !self.header.is_empty() {
            out.set_header(&self.header);
        }
        out.add_rows(&self.rows);
        if let Some(limit) = limit {
            out.set_content_arrangement(ContentArrangement::Dynamic).set_width(limit);
        }
        let last = self.right.len().saturating_sub(1);
        for ((place, column), least) in out.column_iter_mut().enumerate().zip(self.least_widths()) {
            let gap = if place == last { 0 } else { GAP };
            column
                .set_padding((0, gap))
                .set_constraint(ColumnConstraint::LowerBoundary(Width::Fixed(least + gap)));
            if self.right[place] {
                column.set_cell_alignment(CellAlignment::Right);
            }
        }
        out.trim_fmt()
    }

    /// A block for each row, with a line for each column.
    fn blocks(&self, limit: u16) -> String {
        let block = |row: &Vec<String>| {
            let named = self.header.iter().zip(row);
            beside(named.map(|(name, cell)| (name.clone(), cell.clone())), Some(limit))
        };
        self.rows.iter().map(block).collect::<Vec<_>>().join("\n\n")
    }
}

/// Prints the answer of a query. Numbers are aligned to the right and rounded to four digits.
pub fn print(table: &DataFrame) {
    println!("{}", Grid::of_table(table).text(width()));
    if table.height() > MOST_ROWS {
        println!("{} more rows; write all of them with --output FILE.csv", table.height() - MOST_ROWS);
    }
}

/// Prints a table of texts.
pub fn print_texts<const N: usize>(header: [&str; N], rows: Vec<[String; N]>) {
    println!("{}", Grid::of_texts(header, rows).text(Some(width().unwrap_or(LINE))));
}

/// Prints a text, with line breaks between words where the terminal ends.
pub fn print_text(text: &str) {
    println!("{}", fitted(text, width()));
}

/// A text with line breaks between words, so that its lines have at most `limit` characters if that is possible.
pub fn fitted(text: &str, limit: Option<u16>) -> String {
    let Some(limit) = limit else { return text.to_owned() };
    let indent = " ".repeat(text.len() - text.trim_start_matches(' ').len());
    let line = |line: &str| textwrap::fill(line, between_words(limit).subsequent_indent(&indent));
    text.lines().map(line).collect::<Vec<_>>().join("\n")
}

/// Prints texts beside their headings.
pub fn print_beside(entries: impl IntoIterator<Item = (String, String)>) {
    let text = beside(entries, width());
    if !text.is_empty() {
        println!("{text}");
    }
}

/// Texts beside their headings, or below them if the terminal is too narrow for that.
pub fn beside(entries: impl IntoIterator<Item = (String, String)>, limit: Option<u16>) -> String {
    let entries: Vec<(String, String)> = entries.into_iter().collect();
    let widest = entries.iter().map(|(heading, _)| display_width(heading)).max().unwrap_or_default();
    let indent = widest + usize::from(GAP);
    let is_narrow = limit.is_some_and(|limit| usize::from(limit) < indent + LEAST_TEXT);
    let options = between_words(limit.unwrap_or(u16::MAX));
    let entry = |(heading, text): &(String, String)| match is_narrow {
        true => {
            let below = " ".repeat(2 * usize::from(GAP));
            let text = textwrap::fill(text, options.clone().initial_indent(&below).subsequent_indent(&below));
            format!("{}\n{text}", textwrap::fill(heading, options.clone()))
        }
        false => {
            let (first, others) = (format!("{heading:indent$}"), " ".repeat(indent));
            textwrap::fill(text, options.clone().initial_indent(&first).subsequent_indent(&others))
        }
    };
    entries.iter().map(entry).collect::<Vec<_>>().join("\n")
}

/// Prints a command after a heading.
pub fn print_command(heading: &str, command: &str) {
    println!("{}", command_lines(heading, command, width()));
}

/// A command after a heading. If it is too long for a line, it is continued on others, as shells accept it. Words and
/// texts in quotes stay whole.
pub fn command_lines(heading: &str, command: &str, limit: Option<u16>) -> String {
    let Some(limit) = limit.map(usize::from) else { return format!("{heading}{command}") };
    let indent = " ".repeat(display_width(heading) + 2);
    let (mut text, mut line, mut quote) = (String::new(), heading.to_owned(), None);
    let mut words: Vec<String> = vec![String::new()];
    for character in command.chars() {
        match quote {
            None if matches!(character, '\'' | '"') => quote = Some(character),
            Some(open) if open == character => quote = None,
            _ => {}
        }
        match words.last_mut() {
            Some(word) if character != ' ' || quote.is_some() => word.push(character),
            _ => words.push(String::new()),
        }
    }
    let mut is_first = true;
    for word in words {
        // Two more characters: a space and the backslash.
        if !is_first && display_width(&line) + display_width(&word) + 3 > limit {
            text += &format!("{line} \\\n");
            line = format!("{indent}{word}");
        } else {
            line = format!("{line}{}{word}", if is_first { "" } else { " " });
        }
        is_first = false;
    }
    text + &line
}

/// Line breaks only at spaces. Longer words stay whole, because they may be paths or names to copy.
fn between_words(limit: u16) -> Options<'static> {
    Options::new(limit.into()).break_words(false).word_splitter(WordSplitter::NoHyphenation)
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
