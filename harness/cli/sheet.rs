//! Tables for documents: text, Markdown, LaTeX.

use super::table::{Grid, beside, fitted};
use clap::ValueEnum;
use harness::metrics::Metric;

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

    /// The name of a metric with its unit. In text, an arrow says whether higher or lower values are better.
    pub fn metric(self, metric: &str, unit: &str) -> String {
        let name = match metric {
            "smape" | "wmape" | "r2" | "rmse" | "mae" => metric.to_uppercase(),
            name => name.replace('_', " "),
        };
        let name = if unit == "1" { name } else { format!("{name} ({unit})") };
        match self {
            Style::Text => format!("{name} {}", if higher_is_better(metric) { '↑' } else { '↓' }),
            Style::Markdown | Style::Latex => name,
        }
    }
}

/// Whether higher values of the metric with this name are better.
fn higher_is_better(metric: &str) -> bool {
    Metric::named(metric).is_some_and(Metric::higher_is_better)
}

/// The best of some values of a metric, or `None` if there are fewer than two to choose from.
pub fn best(metric: &str, values: &[Option<f64>]) -> Option<f64> {
    let values: Vec<f64> = values.iter().copied().flatten().collect();
    match values.len() {
        0 | 1 => None,
        _ if higher_is_better(metric) => values.into_iter().max_by(f64::total_cmp),
        _ => values.into_iter().min_by(f64::total_cmp),
    }
}

/// A value of a metric, with the decimals that its unit needs.
pub fn rounded(value: f64, unit: &str) -> String {
    let decimals = match unit {
        "%" => 2,
        "1" => 3,
        _ => 4,
    };
    let number = format!("{value:.decimals$}");
    match number.strip_prefix('-') {
        Some(zero) if zero.chars().all(|digit| matches!(digit, '0' | '.')) => zero.to_owned(),
        _ => number,
    }
}

/// A table whose rows consist of some words and some numbers.
pub struct Sheet {
    /// How many of the words are in the title of a part of the table. In text, rows with the same title are a table of
    /// their own.
    pub titles: usize,
    /// The headers of the columns of numbers.
    pub header: Vec<String>,
    /// The rows: the same number of words in each, and numbers in the table's format. A missing number is empty.
    pub rows: Vec<(Vec<String>, Vec<String>)>,
    /// Sentences about the table.
    pub notes: Vec<String>,
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
                let note = format!("{note}; * the best of its row; ↑ higher is better, ↓ lower is better");
                format!("{}\n\n{}\n", self.text(limit), fitted(note.trim_start_matches("; "), limit))
            }
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
        let parts: Vec<Grid> = self
            .rows
            .chunk_by(|(a, _), (b, _)| a[..self.titles] == b[..self.titles])
            .map(|rows| self.part(rows))
            .collect();
        match limit {
            Some(limit) if parts.iter().any(|part| !part.fits(limit)) => self.blocks(limit),
            _ => parts.into_iter().map(|part| part.text(limit)).collect::<Vec<_>>().join("\n\n"),
        }
    }

    /// The table of rows with the same title, which is in the first cell of the header.
    fn part(&self, rows: &[(Vec<String>, Vec<String>)]) -> Grid {
        let words = self.words() - self.titles;
        let title = rows.first().map_or(String::new(), |(words, _)| words[..self.titles].join(", "));
        let mut header = vec![String::new(); words];
        if let Some(first) = header.first_mut() {
            *first = title;
        }
        header.extend(self.header.iter().cloned());
        let rows = rows.iter().map(|(words, numbers)| [&words[self.titles..], numbers].concat());
        let right = (0..header.len()).map(|column| column >= words).collect();
        Grid { rows: rows.collect(), header, right, ruled: false }
    }

    /// A block for each row, with a line for each number.
    fn blocks(&self, limit: u16) -> String {
        let block = |(words, numbers): &(Vec<String>, Vec<String>)| {
            let named = self.header.iter().zip(numbers).filter(|(_, number)| !number.is_empty());
            let lines = named.map(|(name, number)| (format!("  {name}"), number.clone()));
            format!("{}\n{}", fitted(&words.join(", "), Some(limit)), beside(lines, Some(limit)))
        };
        self.rows.iter().map(block).collect::<Vec<_>>().join("\n\n")
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
