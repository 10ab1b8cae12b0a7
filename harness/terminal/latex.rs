//! Tables in LaTeX, with the rules of the package booktabs.

/// A row of a table.
pub fn line(cells: impl Iterator<Item = String>) -> String {
    format!("{} \\\\\n", cells.collect::<Vec<_>>().join(" & "))
}

/// A table with this header and these lines. Some columns are aligned to the right.
pub fn tabular(header: Vec<String>, right: &[bool], body: &str) -> String {
    let columns: String = right.iter().map(|right| if *right { 'r' } else { 'l' }).collect();
    let header = line(header.into_iter());
    format!(
        "\\begin{{tabular}}{{{columns}}}\n\\toprule\n{header}\\midrule\n{body}\\bottomrule\n\\end{{tabular}}\n"
    )
}

/// Escapes a text for LaTeX.
pub fn escaped(text: &str) -> String {
    if text == "R2" {
        return "$R^2$".into();
    }
    let mut escaped = String::new();
    for character in text.chars() {
        match character {
            '\\' => escaped.push_str("\\textbackslash{}"),
            '~' => escaped.push_str("\\textasciitilde{}"),
            '^' => escaped.push_str("\\textasciicircum{}"),
            '_' | '%' | '&' | '#' | '$' | '{' | '}' => escaped.extend(['\\', character]),
            other => escaped.push(other),
        }
    }
    escaped
}
