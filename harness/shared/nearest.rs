//! The name that was probably meant.

/// Returns the name that differs from `found` by the fewest typing errors, or else the dotted name whose last part
/// does. `None` if more than a third of the letters differ.
pub fn nearest<'a>(found: &str, names: &[&'a str]) -> Option<&'a str> {
    // Comparing takes time and memory for each pair of letters; what is this long is no typing error.
    if found.len() > 100 {
        return None;
    }
    let found = found.to_lowercase();
    let tolerated = (found.chars().count() / 3).max(1);
    let nearest_by = |part: fn(&str) -> &str| {
        let errors = |name: &str| strsim::damerau_levenshtein(&found, &part(name).to_lowercase());
        let (errors, name) =
            names.iter().copied().map(|name| (errors(name), name)).min_by_key(|(errors, _)| *errors)?;
        (errors <= tolerated).then_some(name)
    };
    nearest_by(|name| name).or_else(|| nearest_by(|name| name.rsplit('.').next().unwrap_or(name)))
}

/// Returns `; did you mean 'NAME'? ` with the name that was probably meant, or `; `. More words can follow either.
pub fn meant(found: &str, names: &[&str]) -> String {
    nearest(found, names).map_or("; ".to_owned(), |name| format!("; did you mean '{name}'? "))
}
