//! Tables for documents: text, Markdown, LaTeX.

use clap::ValueEnum;
use comfy_table::{CellAlignment, ContentArrangement, Table, presets};

/// The format of a table.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum Style {
    /// For the terminal; `*` marks the best value of a row
    Text,
    /// A pipe table; the best value of a row is bold
    Markdown,
    /// A tabular with booktabs; the best value of a row is bold
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
}

/// A table whose rows consist of some words and some numbers.
pub struct Sheet {
    /// The headers of the columns of numbers.
    pub header: Vec<String>,
    /// The rows: the same number of words in each, and numbers in the table's format. A missing number is empty.
    pub rows: Vec<(Vec<String>, Vec<String>)>,
    /// Sentences about the table.
    pub notes: Vec<String>,
}

impl Sheet {
    /// Writes the table, its notes, and the words that are the same in all rows.
    pub fn render(mut self, style: Style) -> String {
        let same = self.take_constant_words();
        let notes = same.iter().chain(&self.notes).filter(|note| !note.is_empty());
        let note = notes.map(String::as_str).collect::<Vec<_>>().join("; ");
        match style {
            Style::Text => format!("{}\n{note}; * the best of its row\n", self.text()),
            Style::Markdown => format!("{}\n{note}; bold: the best of its row\n", self.markdown()),
            Style::Latex => format!("% {note}; bold: the best of its row\n{}", self.latex()),
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

    fn text(&self) -> Table {
        let mut out = Table::new();
        out.load_preset(presets::UTF8_BORDERS_ONLY).set_content_arrangement(ContentArrangement::Dynamic);
        out.set_header(vec![String::new(); self.words()].into_iter().chain(self.header.iter().cloned()));
        for (words, numbers) in &self.rows {
            out.add_row(words.iter().chain(numbers));
        }
        let numbers = out.column_iter_mut().skip(self.words());
        numbers.for_each(|column| column.set_cell_alignment(CellAlignment::Right));
        out
    }

    fn markdown(&self) -> String {
        let line = |cells: Vec<&str>| format!("| {} |\n", cells.join(" | "));
        let words = self.words();
        let mut text = line([vec![""; words], self.header.iter().map(String::as_str).collect()].concat());
        text += &line([vec!["---"; words], vec!["---:"; self.header.len()]].concat());
        for (words, numbers) in &self.rows {
            text += &line(words.iter().chain(numbers).map(String::as_str).collect());
        }
        text
    }

    fn latex(&self) -> String {
        let line = |cells: Vec<String>| format!("{} \\\\\n", cells.join(" & "));
        let words = self.words();
        let header = self.header.iter().map(|name| escaped(name));
        let mut text =
            format!("\\begin{{tabular}}{{{}{}}}\n", "l".repeat(words), "r".repeat(self.header.len()));
        text += "\\toprule\n";
        text += &line(vec![String::new(); words].into_iter().chain(header).collect());
        text += "\\midrule\n";
        let mut above: &[String] = &[];
        for (words, numbers) in &self.rows {
            if above.first().is_some_and(|word| Some(word) != words.first()) {
                text += "\\addlinespace\n";
            }
            // The first words of a row are left out as long as they are equal to those of the row above.
            let same = words.iter().zip(above).take_while(|(word, above)| word == above).count();
            let shown = words
                .iter()
                .enumerate()
                .map(|(place, word)| if place < same { String::new() } else { escaped(word) });
            text += &line(shown.chain(numbers.iter().cloned()).collect());
            above = words;
        }
        text + "\\bottomrule\n\\end{tabular}\n"
    }
}

/// Escapes a text for LaTeX.
fn escaped(text: &str) -> String {
    if text == "R2" {
        return "$R^2$".into();
    }
    let mut escaped = String::new();
    for character in text.chars() {
        if "_%&#$".contains(character) {
            escaped.push('\\');
        }
        escaped.push(character);
    }
    escaped
}
