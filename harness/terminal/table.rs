//! Tables and texts that fit the terminal.
//!
//! A table that is too wide for the terminal is wrapped between words. If this is not enough, each row becomes a block
//! with a line for each column. If the output is no terminal, tables are as wide as their contents, so that the output
//! of a command does not depend on where it is called.

use crate::terminal::encoding::{IS_UTF8, encoded};
use crate::terminal::latex::{escaped, line, tabular};
use comfy_table::{CellAlignment, ColumnConstraint, ContentArrangement, Table, Width};
use harness_shared::numbers::rounded;
use polars::prelude::{AnyValue, DataFrame};
use std::borrow::Cow;
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
/// A space at which no line is broken. It is printed as a plain space.
pub const HARD_SPACE: char = '\u{a0}';

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
    /// The names of the columns.
    pub header: Vec<String>,
    /// The cells of each row.
    pub rows: Vec<Vec<String>>,
    /// Whether the cells of each column are aligned to the right. Their lines are not broken, because they are numbers.
    pub right: Vec<bool>,
    /// Whether the lines of the cells of each column are not broken; none if it is empty.
    pub whole: Vec<bool>,
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
            ..Self::default()
        }
    }

    /// The first rows of a table, at most `limit`.
    pub fn of_table(table: &DataFrame, limit: usize) -> Self {
        let cells = |row| {
            let values = table.columns().iter().map(move |column| column.get(row));
            values.map(|value| value.map_or(String::new(), cell)).collect()
        };
        Self {
            header: table.get_column_names().into_iter().map(|name| name.to_string()).collect(),
            rows: (0..table.height().min(limit)).map(cells).collect(),
            right: table.columns().iter().map(|column| column.dtype().is_numeric()).collect(),
            ..Self::default()
        }
    }

    /// The text of the table, at most `limit` characters wide if that is possible.
    pub fn text(mut self, limit: Option<u16>) -> String {
        // The widths of the columns are those of the text as it is shown.
        if limit.is_some() && !*IS_UTF8 {
            let cells = self.rows.iter_mut().flatten().chain(&mut self.header);
            cells.for_each(|cell| {
                let parts: Vec<Cow<str>> = cell.split(HARD_SPACE).map(encoded).collect();
                *cell = parts.join(&HARD_SPACE.to_string());
            });
        }
        with_spaces(&match limit {
            Some(limit) if !self.fits(limit) => self.blocks(limit),
            _ => self.lines(limit),
        })
    }

    /// The table in Markdown.
    pub fn markdown(&self) -> String {
        let cell = |text: &String| with_spaces(text).replace('|', "\\|").replace('\n', "<br>");
        let line = |cells: Vec<String>| format!("| {} |\n", cells.join(" | "));
        let ruler = self.right.iter().map(|right| if *right { "---:" } else { "---" }.to_owned());
        let rows = self.rows.iter().map(|row| line(row.iter().map(cell).collect()));
        line(self.header.iter().map(cell).collect()) + &line(ruler.collect()) + &rows.collect::<String>()
    }

    /// The table in LaTeX.
    pub fn latex(&self) -> String {
        let cell = |text: &String| escaped(&with_spaces(text).replace('\n', " "));
        let body: String = self.rows.iter().map(|row| line(row.iter().map(cell))).collect();
        tabular(self.header.iter().map(cell).collect(), &self.right, &body)
    }

    /// Whether the table is at most `limit` characters wide if no word, and no line of a whole column, is broken.
    pub fn fits(&self, limit: u16) -> bool {
        is_within(&self.least_widths(), limit)
    }

    /// Whether the table is at most `limit` characters wide if no line of any cell and of the header is broken.
    pub fn fits_unbroken(&self, limit: u16) -> bool {
        is_within(&self.widths(true, |_| true), limit)
    }

    /// The width of the longest word of each column, or of its longest line if its lines are not broken.
    fn least_widths(&self) -> Vec<u16> {
        self.widths(false, |column| self.right[column] || self.whole.get(column) == Some(&true))
    }

    /// The width of each column if its header is whole or not, and if its lines are, for which `is_whole` is true.
    /// Otherwise, the width is that of the longest word.
    fn widths(&self, has_whole_header: bool, is_whole: impl Fn(usize) -> bool) -> Vec<u16> {
        let longest = |text: &String, is_whole| {
            let breaks: &[char] = if is_whole { &['\n'] } else { &[' ', '\n'] };
            text.split(breaks).map(display_width).max().unwrap_or_default()
        };
        let width = |column: usize| {
            let header = self.header.get(column).map(|name| longest(name, has_whole_header));
            let cells = self.rows.iter().filter_map(|row| row.get(column));
            cells.map(|cell| longest(cell, is_whole(column))).chain(header).max().unwrap_or_default()
        };
        (0..self.right.len()).map(|column| u16::try_from(width(column)).unwrap_or(u16::MAX - GAP)).collect()
    }

    fn lines(&self, limit: Option<u16>) -> String {
        let mut out = Table::new();
        out.load_preset(if self.ruled { RULED } else { PLAIN });
        if !self.header.is_empty() {
            out.set_header(&self.header);
        }
        out.add_rows(&self.rows);
        if let Some(limit) = limit.filter(|limit| !self.fits_unbroken(*limit)) {
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

/// Whether columns of these widths, with the gaps between them, take at most `limit` characters.
fn is_within(widths: &[u16], limit: u16) -> bool {
    let width: u32 = widths.iter().map(|width| u32::from(*width) + u32::from(GAP)).sum();
    width <= u32::from(limit) + u32::from(GAP)
}

/// Prints the answer of a query. Numbers are aligned to the right and rounded to four digits.
pub fn print(table: &DataFrame) {
    println!("{}", Grid::of_table(table, MOST_ROWS).text(width()));
    if table.height() > MOST_ROWS {
        let more = table.height() - MOST_ROWS;
        print_text(&format!(
            "{more} more rows; print all with `--format csv`, or write them with `--output FILE.csv`"
        ));
    }
}

/// Prints a table of texts.
pub fn print_texts<const N: usize>(header: [&str; N], rows: Vec<[String; N]>) {
    print_grid(Grid::of_texts(header, rows));
}

/// Prints a table whose texts may have any length.
pub fn print_grid(grid: Grid) {
    println!("{}", grid.text(Some(width().unwrap_or(LINE))));
}

/// Prints a text, with line breaks between words where the terminal ends.
pub fn print_text(text: &str) {
    println!("{}", fitted(text, width()));
}

/// A text with line breaks between words, so that its lines have at most `limit` characters if that is possible.
pub fn fitted(text: &str, limit: Option<u16>) -> String {
    let Some(limit) = limit else { return with_spaces(text) };
    let line = |line: &str| {
        let indent = " ".repeat(line.len() - line.trim_start_matches(' ').len());
        wrapped(line, between_words(limit).subsequent_indent(&indent))
    };
    text.lines().map(line).collect::<Vec<_>>().join("\n")
}

/// Breaks a text into lines. Commands between backticks stay whole, because a reader copies them.
fn wrapped(text: &str, options: Options) -> String {
    with_spaces(&textwrap::fill(&with_whole_commands(text), options))
}

/// A text whose spaces between backticks are hard.
fn with_whole_commands(text: &str) -> String {
    let parts: Vec<&str> = text.split('`').collect();
    // With an even number of parts, one backtick has no partner.
    if parts.len().is_multiple_of(2) {
        return text.to_owned();
    }
    let part =
        |(place, part): (usize, &&str)| if place % 2 == 1 { unbroken(part) } else { (*part).to_owned() };
    parts.iter().enumerate().map(part).collect::<Vec<_>>().join("`")
}

/// A text at whose spaces no line is broken.
pub fn unbroken(text: &str) -> String {
    text.replace(' ', &HARD_SPACE.to_string())
}

/// A text with plain spaces.
fn with_spaces(text: &str) -> String {
    text.replace(HARD_SPACE, " ")
}

/// Prints texts beside their headings.
pub fn print_beside(entries: impl IntoIterator<Item = (String, String)>) {
    let text = beside(entries, width());
    if !text.is_empty() {
        println!("{text}");
    }
}

/// Texts beside their headings. A text for which there is no room stands below its heading.
pub fn beside(entries: impl IntoIterator<Item = (String, String)>, limit: Option<u16>) -> String {
    let entries: Vec<(String, String)> = entries.into_iter().collect();
    let widest = entries.iter().map(|(heading, _)| display_width(heading)).max().unwrap_or_default();
    let indent = widest + usize::from(GAP);
    let options = between_words(limit.unwrap_or(u16::MAX));
    let entry = |(heading, text): &(String, String)| {
        let text = with_whole_commands(text);
        let longest = text.split(' ').map(display_width).max().unwrap_or_default();
        let is_narrow = limit.is_some_and(|limit| usize::from(limit) < indent + longest.max(LEAST_TEXT));
        if text.is_empty() {
            heading.trim_end().to_owned()
        } else if is_narrow {
            let below = " ".repeat(2 * usize::from(GAP));
            let text = wrapped(&text, options.clone().initial_indent(&below).subsequent_indent(&below));
            format!("{}\n{text}", wrapped(heading.trim_end(), options.clone()))
        } else {
            let (first, others) = (format!("{heading:indent$}"), " ".repeat(indent));
            wrapped(&text, options.clone().initial_indent(&first).subsequent_indent(&others))
        }
    };
    entries.iter().map(entry).collect::<Vec<_>>().join("\n")
}

/// Prints a command after a heading.
pub fn print_command(heading: &str, command: &str) {
    println!("{}", command_lines(heading, command, width()));
}

/// A command after a heading. If it is too long for a line, it is continued on others, as shells accept it. Words and
/// texts in quotes stay whole, and an option stays on the line of its value.
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
    for word in with_values(words) {
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

/// The words of a command, in which an option and the word after it are one.
fn with_values(words: Vec<String>) -> Vec<String> {
    let mut joined: Vec<String> = Vec::new();
    for word in words {
        match joined.last_mut() {
            Some(option)
                if option.starts_with("--") && !option.contains([' ', '=']) && !word.starts_with('-') =>
            {
                *option = format!("{option} {word}");
            }
            _ => joined.push(word),
        }
    }
    joined
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
        AnyValue::BinaryOwned(bytes) => format!("{} bytes", bytes.len()),
        other => other.to_string(),
    }
}

/// A path for messages. It is absolute if the current folder is known.
pub fn shown(path: &Path) -> String {
    std::path::absolute(path).unwrap_or_else(|_| path.to_owned()).display().to_string()
}
