//! Tables for documents: text, Markdown, LaTeX.

use super::latex::{escaped, line, tabular};
use super::table::{Grid, HARD_SPACE, beside, fitted, unbroken};
use harness::metrics::{higher_is_better, label};
use textwrap::core::display_width;

/// The number of columns of a text from which on columns become rows, if these are fewer.
pub const MOST_COLUMNS: usize = 12;
/// A number that a run lacks.
pub const MISSING: &str = "-";

/// The format of a table.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Style {
    /// For the terminal; `*` marks the best value of a row.
    Text,
    /// A pipe table; the best value of a row is bold.
    Markdown,
    /// A tabular with booktabs; the best value of a row is bold.
    Latex,
}

impl Style {
    /// A mean with half of its interval, marked if it is the best of its row.
    pub fn number(self, mean: &str, half: Option<&str>, best: bool) -> String {
        let sign = if self == Style::Latex { r"\pm" } else { "±" };
        let number = half.map_or(mean.to_owned(), |half| format!("{mean} {sign} {half}"));
        match (self, best) {
            (Style::Text, true) => format!("*{number}"),
            (Style::Markdown, true) => format!("**{number}**"),
            (Style::Latex, true) => format!(r"$\mathbf{{{number}}}$"),
            (Style::Latex, false) => format!("${number}$"),
            (_, false) => number,
        }
    }

    /// The name of a metric with its unit. In text, an arrow says whether higher or lower values are better, unless the
    /// metric is a user's own.
    pub fn metric(self, metric: &str, unit: &str) -> String {
        let name = label(metric, unit);
        match self {
            Style::Text => match higher_is_better(metric) {
                Some(is_higher) => format!("{name}{HARD_SPACE}{}", if is_higher { '↑' } else { '↓' }),
                None => name,
            },
            Style::Markdown | Style::Latex => name,
        }
    }
}

/// Which numbers of a table are marked.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub enum Mark {
    /// The best of each row.
    #[default]
    Best,
    /// The differences that are significant.
    Significant,
}

impl Mark {
    /// What is marked, in a table whose rows are called `row`.
    fn meaning(self, row: &str) -> String {
        match self {
            Self::Best => format!("the best of its {row}"),
            Self::Significant => {
                "differs with p < 0.05, corrected for all differences by Holm's method".to_owned()
            }
        }
    }
}

/// A table whose rows consist of some words and some numbers.
#[derive(Default)]
pub struct Sheet {
    /// How many of the words are in the title of a part of the table. In text, rows with the same title are a table of
    /// their own.
    pub titles: usize,
    /// The headers of the columns of numbers.
    pub header: Vec<String>,
    /// The rows: the same number of words in each, and numbers in the table's format. A missing number is empty.
    pub rows: Vec<(Vec<String>, Vec<String>)>,
    /// Which numbers are marked.
    pub mark: Mark,
    /// Sentences about the table.
    pub notes: Vec<String>,
    /// Words of the table that stand for longer ones, with their meaning. It is printed below a text.
    pub legend: Vec<(String, String)>,
}

impl Sheet {
    /// Writes the table, its notes, and the words that are the same in all rows. A text is at most `limit` characters
    /// wide, if there is a limit.
    pub fn render(mut self, style: Style, limit: Option<u16>) -> String {
        let same = self.take_constant_words();
        let notes = same.iter().chain(&self.notes).filter(|note| !note.is_empty());
        let note = notes.map(String::as_str).collect::<Vec<_>>().join("; ");
        match style {
            Style::Text => {
                let of = if self.is_turned() { "column" } else { "row" };
                let marked = self.mark.meaning(of);
                let note = format!("{note}; * {marked}; ↑ higher is better, ↓ lower is better");
                let legend = beside(self.legend.iter().cloned(), limit);
                let note = fitted(note.trim_start_matches("; "), limit);
                let parts = [self.text(limit), legend, note].into_iter().filter(|part| !part.is_empty());
                parts.collect::<Vec<_>>().join("\n\n") + "\n"
            }
            Style::Markdown => format!("{}\n{note}; bold: {}\n", self.markdown(), self.mark.meaning("row")),
            Style::Latex => format!("% {note}; bold: {}\n{}", self.mark.meaning("row"), self.latex()),
        }
    }

    /// Removes the columns of words that are the same in every row, and returns these words. A single row keeps its
    /// words, except empty ones.
    fn take_constant_words(&mut self) -> Vec<String> {
        let mut constant = Vec::new();
        let mut place = 0;
        while let Some(word) = self.rows.first().and_then(|(words, _)| words.get(place)).cloned() {
            if (self.rows.len() > 1 || word.is_empty())
                && self.rows.iter().all(|(words, _)| words[place] == word)
            {
                self.rows.iter_mut().for_each(|(words, _)| drop(words.remove(place)));
                self.titles -= usize::from(place < self.titles);
                constant.push(word);
            } else {
                place += 1;
            }
        }
        constant
    }

    fn words(&self) -> usize {
        self.rows.first().map_or(0, |(words, _)| words.len())
    }

    /// A table for each title. If one of them is too wide, all rows become blocks.
    fn text(&self, limit: Option<u16>) -> String {
        let parts = self.rows.chunk_by(|(a, _), (b, _)| a[..self.titles] == b[..self.titles]);
        let grid = |rows| if self.is_turned() { self.turned(rows) } else { self.grid(rows) };
        let parts: Vec<(String, Grid)> = parts.map(|rows| (self.title(rows), grid(rows))).collect();
        match limit {
            Some(limit) if parts.iter().any(|(_, grid)| !grid.fits(limit)) => self.blocks(limit),
            _ => {
                let text = |(title, grid): (String, Grid)| {
                    let line = if title.is_empty() { title } else { fitted(&title, limit) + "\n" };
                    line + &grid.text(limit)
                };
                parts.into_iter().map(text).collect::<Vec<_>>().join("\n\n")
            }
        }
    }

    /// The words that rows have in common.
    fn title(&self, rows: &[(Vec<String>, Vec<String>)]) -> String {
        rows.first().map_or(String::new(), |(words, _)| joined(&words[..self.titles]))
    }

    /// The table of rows with the same title, without columns that are empty in these rows.
    fn grid(&self, rows: &[(Vec<String>, Vec<String>)]) -> Grid {
        let words = self.words() - self.titles;
        let is_used = |column: &usize| rows.iter().any(|(_, numbers)| !numbers[*column].is_empty());
        let used: Vec<usize> = (0..self.header.len()).filter(is_used).collect();
        let of_used = |cells: &[String]| used.iter().map(|column| cells[*column].clone()).collect::<Vec<_>>();
        let header = [vec![String::new(); words], of_used(&self.header)].concat();
        let rows = rows.iter().map(|(words, numbers)| [&words[self.titles..], &of_used(numbers)].concat());
        let right = (0..header.len()).map(|column| column >= words).collect();
        Grid { rows: rows.collect(), header, right, ..Grid::default() }
    }

    /// Whether columns are rows in a text, because there are many columns, and more than rows with the same title.
    fn is_turned(&self) -> bool {
        let mut parts = self.rows.chunk_by(|(a, _), (b, _)| a[..self.titles] == b[..self.titles]);
        self.header.len() > MOST_COLUMNS && parts.all(|rows| rows.len() < self.header.len())
    }

    /// The table of rows with the same title, with a row for each column that is not empty in them.
    fn turned(&self, rows: &[(Vec<String>, Vec<String>)]) -> Grid {
        let names = rows.iter().map(|(words, _)| words[self.titles..].join(" "));
        let header: Vec<String> = std::iter::once(String::new()).chain(names).collect();
        let row = |(column, name): (usize, &String)| {
            let numbers = rows.iter().map(|(_, numbers)| numbers[column].clone());
            std::iter::once(name.clone()).chain(numbers).collect::<Vec<_>>()
        };
        let all = self.header.iter().enumerate().map(row);
        let used = all.filter(|row| row[1..].iter().any(|number| !number.is_empty()));
        let right = (0..header.len()).map(|column| column > 0).collect();
        Grid { rows: used.collect(), header, right, ..Grid::default() }
    }

    /// A block for each row, with a line for each number. The numbers are aligned.
    fn blocks(&self, limit: u16) -> String {
        let mean = |number: &str| display_width(number.split(" ±").next().unwrap_or_default());
        let block = |(words, numbers): &(Vec<String>, Vec<String>)| {
            let is_there = |number: &&String| !number.is_empty() && *number != MISSING;
            let widest = numbers.iter().filter(is_there).map(|number| mean(number)).max().unwrap_or_default();
            let named = self.header.iter().zip(numbers).filter(|(_, number)| is_there(number));
            let lines = named.map(|(name, number)| {
                let indent = " ".repeat(widest - mean(number));
                (format!("  {name}"), unbroken(&format!("{indent}{number}")))
            });
            format!("{}\n{}", fitted(&joined(words), Some(limit)), beside(lines, Some(limit)))
        };
        self.rows.iter().map(block).collect::<Vec<_>>().join("\n\n")
    }

    fn markdown(&self) -> String {
        let words = vec![String::new(); self.words()];
        let right = [vec![false; words.len()], vec![true; self.header.len()]].concat();
        let header = [words, self.header.clone()].concat();
        let rows = self.rows.iter().map(|(words, numbers)| [&words[..], numbers].concat()).collect();
        Grid { header, rows, right, ..Grid::default() }.markdown()
    }

    fn latex(&self) -> String {
        let words = vec![String::new(); self.words()];
        let right = [vec![false; words.len()], vec![true; self.header.len()]].concat();
        let header: Vec<String> = self.header.iter().map(|name| escaped(name)).collect();
        let (mut body, mut above): (String, &[String]) = (String::new(), &[]);
        for (words, numbers) in &self.rows {
            if above.first().is_some_and(|word| Some(word) != words.first()) {
                body += "\\addlinespace\n";
            }
            // The first words of a row are left out as long as they are equal to those of the row above.
            let same = words.iter().zip(above).take_while(|(word, above)| word == above).count();
            let shown = words
                .iter()
                .enumerate()
                .map(|(place, word)| if place < same { String::new() } else { escaped(word) });
            body += &line(shown.chain(numbers.iter().cloned()));
            above = words;
        }
        tabular([words, header].concat(), &right, &body)
    }
}

/// Words with commas between them, without empty ones.
fn joined(words: &[String]) -> String {
    words.iter().map(String::as_str).filter(|word| !word.is_empty()).collect::<Vec<_>>().join(", ")
}
