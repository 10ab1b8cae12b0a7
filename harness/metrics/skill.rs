//! The skill of a prediction over that of persistence, and the horizon up to which it lasts.

/// The skill score of a prediction: `1 - E / E_p`, where E is its mean squared error, and E_p that of persistence on
/// the same samples (Murphy, 1988, "Skill scores based on the mean square error"). 1 is a perfect prediction, and 0 is
/// no better than persistence. `None` if persistence has no error.
///
/// # Arguments
/// * `rmse`: root mean squared error of the prediction
/// * `of_persistence`: root mean squared error of persistence, in the same unit
pub fn skill(rmse: f64, of_persistence: f64) -> Option<f64> {
    (of_persistence > 0.0).then(|| 1.0 - (rmse / of_persistence).powi(2))
}

/// The forecast skill horizon: the largest horizon up to which the skill is positive at every judged horizon (Buizza
/// and Leutbecher, 2015, "The forecast skill horizon"). 0 if the skill is not positive at the first one. If the skill
/// is positive at all of them, the last one is a lower bound.
///
/// # Arguments
/// * `skills`: each judged horizon with the skill, by ascending horizon
pub fn skill_horizon(skills: impl IntoIterator<Item = (usize, f64)>) -> usize {
    skills.into_iter().take_while(|(_, skill)| *skill > 0.0).last().map_or(0, |(horizon, _)| horizon)
}
