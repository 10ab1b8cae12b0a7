//! Draws the paper's nine figures, one about predictions further ahead, and one about categories, from the tables of
//! finished runs.
//!
//! Each figure has a file of its own, which makes a [`Drawing`]: a [`page::Page`] and the numbers on it. `simulation`
//! renders the scenes. The diagrams show the parameters of the networks that `learning` builds. All other numbers come
//! from [`source::Source`], which uses the runs that [`analysis`](harness_analysis) selects. The same tables give the
//! same bytes of SVG.

mod anatomy;
mod axes;
mod confusion;
mod curves;
mod diagram;
mod forces_dataset;
mod horizon;
mod information_loss_arch;
mod moment;
pub mod page;
mod pdf;
mod plot;
mod prediction_results;
mod predictive_arch;
mod propriovision_to_vision;
mod reading;
mod reconstruction_performance;
mod regression;
mod shown;
mod sim_env;
pub mod source;
mod task;
mod text;

pub use forces_dataset::SQL as FORCES_SQL;
use harness_analysis::{Analysis, AnalysisError, Key, Labels, Mixed, Question, Setting, finished};
use harness_catalog::{QueryError, save};
use harness_learning::LearningError;
use harness_shared::files::{WriteError, write_bytes};
use harness_simulation::SimulationError;
use harness_spec::Task;
pub use moment::{Bars, Moment};
use page::Page;
pub use plot::Plot;
use polars::prelude::{DataFrame, PolarsError};
pub use reading::{OfReading, ReadingError};
pub use shown::Shown;
use source::Source;
use std::ffi::OsStr;
use std::path::{Path, PathBuf};

/// Why a figure can't be drawn.
#[derive(Debug, thiserror::Error)]
pub enum FigureError {
    /// An experiment that the figure needs has no finished run.
    #[error(
        "{} has no finished runs of {experiment}; {}",
        root.display(),
        command.as_ref().map_or_else(|| finished(experiment, there), |command| format!("make them with `{command}`"))
    )]
    NoRuns {
        /// The experiment's name.
        experiment: String,
        /// The results folder.
        root: PathBuf,
        /// The command that makes the missing runs. `None` if there is no spec of the experiment's name.
        command: Option<String>,
        /// The names of the experiments that have finished runs.
        there: Vec<String>,
    },
    /// A role under a reading of an experiment has no finished runs, and no others stand for them.
    #[error(
        "there are no finished runs of {experiment} under the reading '{reading}' in the role {role}{}",
        match (&excluded_by[..], command) {
            ([], None) => String::new(),
            ([], Some(command)) => format!("; make them with `{command}`"),
            (settings, _) => format!(
                " with {}, and there are others; choose by other settings",
                settings.iter().map(Setting::to_string).collect::<Vec<_>>().join(" and ")
            ),
        }
    )]
    NoRole {
        /// The experiment's name.
        experiment: String,
        /// The reading's name.
        reading: String,
        /// The role's name.
        role: &'static str,
        /// The requested settings, if there are runs without them.
        excluded_by: Vec<Setting>,
        /// The command that makes the experiment's runs. `None` if there is no spec of the experiment's name.
        command: Option<String>,
    },
    /// The means of a plot differ in a key that the plot does not show.
    #[error(
        "the means differ in {key}: {}; {}",
        values.join("; "),
        if *can_distinguish {
            "distinguish them with --by or --facet, or choose some of them with --of, --horizon, --where or the names of \
             experiments"
        } else {
            "choose some of them with --where"
        }
    )]
    Ambiguous {
        /// Whether the caller chooses the keys that the plot shows.
        can_distinguish: bool,
        /// The name of the key.
        key: &'static str,
        /// The key's values.
        values: Vec<String>,
    },
    /// A plot shows one metric. The field has those of the question.
    #[error("a plot shows one metric; choose one of {} with --metrics, or tell them apart with --x, --by or --facet metric", .0.join(", "))]
    SeveralMetrics(Vec<String>),
    /// A plot would have too many series or panels to be read.
    #[error(
        "a plot has at most 12 series and 8 panels, and this one would have {series} and {panels}; choose some of the \
         means with --of, --where or the names of experiments"
    )]
    TooMany {
        /// The number of series.
        series: usize,
        /// The number of panels.
        panels: usize,
    },
    /// No column has runs with the same seeds as the one with this heading.
    #[error("no other column has runs with the same seeds as {0}, so there are no differences to draw")]
    NoDifferences(String),
    /// An experiment has finished runs, but a query over them gives no rows.
    #[error(
        "the finished runs of {experiment} in {} ({there}) have no rows for the figure: a scenario, a task, an output or, \
         in published runs, a table is missing{}",
        root.display(),
        command.as_ref().map_or_else(String::new, |command| {
            format!("; `{command}` makes runs that have more")
        })
    )]
    NoRows {
        /// The experiment's name.
        experiment: String,
        /// The results folder.
        root: PathBuf,
        /// The scenarios, tasks and outputs of the runs.
        there: String,
        /// The command that makes runs with other scenarios, tasks or outputs. `None` if the experiment's spec asks for
        /// none, or there is no spec of its name.
        command: Option<String>,
    },
    /// The runs differ in their settings and can't be shown in one figure.
    #[error(transparent)]
    Mixed(#[from] Mixed),
    /// The runs can't be selected.
    #[error(transparent)]
    Analysis(#[from] AnalysisError),
    /// A query can't be answered, or the numbers can't be saved.
    #[error(transparent)]
    Query(#[from] QueryError),
    /// The figure shows only the paper's robot or its experiments, or what only runs with a longer horizon have. The
    /// text is the message.
    #[error("{0}")]
    NothingToDraw(String),
    /// A column of a table is missing or has an unexpected type, or a table can't be built.
    #[error("a table has unexpected columns or values: {0}")]
    Table(#[from] PolarsError),
    /// A scene can't be simulated or rendered.
    #[error(transparent)]
    Simulation(#[from] SimulationError),
    /// A network that a diagram shows can't be built.
    #[error(transparent)]
    Learning(#[from] LearningError),
    /// A picture can't be encoded or drawn, for the given reason.
    #[error("the picture can't be made: {0}")]
    Picture(String),
    /// A file can't be written.
    #[error(transparent)]
    Write(#[from] WriteError),
}

impl FigureError {
    /// The same error about a figure, which has no keys to choose.
    fn of_figure(self) -> Self {
        match self {
            Self::Ambiguous { key, values, .. } => Self::Ambiguous { can_distinguish: false, key, values },
            other => other,
        }
    }

    /// Whether nothing failed, but there is nothing to draw: runs or rows of their tables are missing.
    pub fn has_nothing_to_draw(&self) -> bool {
        matches!(
            self,
            Self::NoRuns { .. }
                | Self::NoRole { .. }
                | Self::NoRows { .. }
                | Self::NothingToDraw(_)
                | Self::Analysis(AnalysisError::NoMeans(_) | AnalysisError::UnknownModality(_))
        )
    }
}

/// A figure of the paper, or one of the others.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Figure {
    /// The finger pressed on the ground among movable boxes.
    Task,
    /// The robot, its joints, and the finger close up.
    SimEnv,
    /// The network that predicts the next observation.
    PredictiveArch,
    /// The network that reconstructs the observation.
    InformationLossArch,
    /// Contact and force by link, in both scenarios.
    ForcesDataset,
    /// Prediction errors over the latent size, with and without vision as an input.
    PredictionResults,
    /// The predicted change of the camera's image beside the reference.
    PropriovisionToVision,
    /// Reconstruction errors over the latent size, with and without vision as an input.
    ReconstructionPerformance,
    /// Predictions over references at the fingertip.
    Regression,
    /// Error and skill over the horizon. The paper has no such figure.
    Horizon,
    /// The confusion of categories, of any experiment. The paper has no such figure.
    Confusion,
}

/// A file format in which a figure is saved.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Format {
    /// The page as an SVG document.
    Svg,
    /// The page as a PNG of 600 pixels per inch.
    Png,
    /// The page as a PDF document, whose text can be searched and copied.
    Pdf,
    /// The numbers that the figure shows.
    Csv,
}

impl Format {
    /// All formats.
    pub const ALL: [Format; 4] = [Format::Svg, Format::Png, Format::Pdf, Format::Csv];

    /// The extension of the file's name, without the dot.
    pub fn name(self) -> &'static str {
        match self {
            Format::Svg => "svg",
            Format::Png => "png",
            Format::Pdf => "pdf",
            Format::Csv => "csv",
        }
    }

    /// The format that the ending of a file's name stands for.
    ///
    /// # Errors
    /// When it stands for none. The message lists the endings.
    pub fn of(path: &Path) -> Result<Self, String> {
        let ending = path.extension().and_then(OsStr::to_str);
        let found = Self::ALL.into_iter().find(|format| Some(format.name()) == ending);
        found.ok_or_else(|| "the file's name must end in .svg, .png, .pdf or .csv".into())
    }
}

/// A figure and the numbers that it shows.
pub struct Drawing {
    /// The figure itself.
    pub page: Page,
    /// The numbers that the figure shows, as rows of its CSV file.
    pub data: DataFrame,
}

impl Figure {
    /// The paper's figures in the paper's order, then the others.
    pub const ALL: [Figure; 11] = [
        Figure::Task,
        Figure::PredictiveArch,
        Figure::InformationLossArch,
        Figure::SimEnv,
        Figure::ForcesDataset,
        Figure::PredictionResults,
        Figure::PropriovisionToVision,
        Figure::ReconstructionPerformance,
        Figure::Regression,
        Figure::Horizon,
        Figure::Confusion,
    ];

    /// The paper's figures in the paper's order: the first ones of [`Figure::ALL`].
    pub const OF_THE_PAPER: [Figure; 9] = *Self::ALL.first_chunk().unwrap();

    /// The name in files and on the command line. It is the figure's label in the paper.
    pub fn name(self) -> &'static str {
        match self {
            Figure::Task => "task",
            Figure::SimEnv => "sim_env",
            Figure::PredictiveArch => "predictive_arch",
            Figure::InformationLossArch => "information_loss_arch",
            Figure::ForcesDataset => "forces_dataset",
            Figure::PredictionResults => "prediction_results",
            Figure::PropriovisionToVision => "propriovision_to_vision",
            Figure::ReconstructionPerformance => "reconstruction_performance",
            Figure::Regression => "regression",
            Figure::Horizon => "horizon",
            Figure::Confusion => "confusion",
        }
    }

    /// What the figure shows, in a few words for people.
    pub fn meaning(self) -> &'static str {
        match self {
            Figure::Task => "the finger pressed on the ground among movable boxes",
            Figure::SimEnv => "the robot, its joints, and the finger close up",
            Figure::PredictiveArch => "the network that predicts the next observation",
            Figure::InformationLossArch => "the network that reconstructs the observation",
            Figure::ForcesDataset => "contact and force by link, both scenarios",
            Figure::PredictionResults => "prediction errors over latent size, single- and multi-modal",
            Figure::PropriovisionToVision => "predicted change of the image beside the reference",
            Figure::ReconstructionPerformance => {
                "reconstruction errors over latent size, single- and multi-modal"
            }
            Figure::Regression => "prediction over reference at the fingertip",
            Figure::Horizon => "error and skill of predictions over the horizon",
            Figure::Confusion => "which categories are predicted as which",
        }
    }

    /// Whether the figure depends on runs. The other figures only show the simulated scenes.
    pub fn shows_runs(self) -> bool {
        !matches!(self, Figure::Task | Figure::SimEnv)
    }

    /// Draws the figure.
    ///
    /// # Errors
    /// When there is nothing to draw ([`FigureError::has_nothing_to_draw`]), or when a table can't be read or a picture
    /// made.
    pub fn render(self, source: &Source) -> Result<Drawing, FigureError> {
        match self {
            Figure::Task => task::render(),
            Figure::SimEnv => sim_env::render(),
            Figure::PredictiveArch => predictive_arch::render(source),
            Figure::InformationLossArch => information_loss_arch::render(source),
            Figure::ForcesDataset => forces_dataset::render(source),
            Figure::PredictionResults => prediction_results::render(source),
            Figure::PropriovisionToVision => propriovision_to_vision::render(source),
            Figure::ReconstructionPerformance => reconstruction_performance::render(source),
            Figure::Regression => regression::render(source),
            Figure::Horizon => horizon::render(source),
            Figure::Confusion => Err(FigureError::NothingToDraw(
                "it shows categories, which the paper does not predict; name an experiment that predicts some with \
                 --experiment"
                    .to_owned(),
            )),
        }
    }
}

impl Figure {
    /// Draws what the figure shows for an experiment of any robot. `modality` is that of [`Figure::Horizon`] and
    /// [`Figure::Confusion`]; see [`Source::showing`]. A figure that can't show several variants shows the first one, and
    /// says so.
    ///
    /// # Errors
    /// When the figure shows only the paper's robot, when the experiment's runs have nothing for it
    /// ([`FigureError::has_nothing_to_draw`] in both cases), or when a table can't be read or a picture made.
    pub fn render_of(
        self,
        analysis: &Analysis,
        experiment: &str,
        modality: Option<String>,
    ) -> Result<Drawing, FigureError> {
        let variants = source::variants(analysis, experiment);
        let first = variants.first().filter(|_| variants.len() > 1);
        let experiments = source::Experiments::all_of(experiment);
        let source = Source::new(analysis, experiments).showing(modality).only(first.cloned());
        let runs = || source.runs_of(experiment, first.map(String::as_str));
        let remark = first.map(|first| {
            let label = Labels::new(analysis, &[]).variant(first);
            format!("only the first of {} variants: {}", variants.len(), label.text())
        });
        let with_remark = |drawing: Drawing| drawing.with_remark(remark.as_deref());
        let over_latent = |task| {
            let usual = Question { task: Some(task), ..Question::default() }.answer(analysis)?.by[0];
            let plot = Plot::over(usual, task);
            let mut answer = plot.question.answer(analysis)?;
            let one = first.filter(|_| plot.x == Key::Latent);
            answer.cells.retain(|cell| one.is_none_or(|first| cell.of.variant == *first));
            let drawing = plot.draw(&answer).map_err(FigureError::of_figure)?;
            Ok(if one.is_some() { with_remark(drawing) } else { drawing })
        };
        match self {
            Figure::Task | Figure::SimEnv => Err(FigureError::NothingToDraw(
                "it shows the paper's scene; `harness render` draws any world".to_owned(),
            )),
            Figure::PredictiveArch => predictive_arch::render(&source).map(with_remark),
            Figure::InformationLossArch => information_loss_arch::render(&source).map(with_remark),
            Figure::ForcesDataset => {
                let runs = source.runs_for_data(experiment)?;
                let drawing = forces_dataset::render_of(&runs)?;
                Ok(if runs.variant.is_some() { with_remark(drawing) } else { drawing })
            }
            Figure::PredictionResults => over_latent(Task::Prediction),
            Figure::PropriovisionToVision => propriovision_to_vision::render_of(&runs()?).map(with_remark),
            Figure::ReconstructionPerformance => over_latent(Task::Reconstruction),
            Figure::Regression => regression::render_of(runs()?).map(with_remark),
            Figure::Horizon => horizon::render(&source),
            Figure::Confusion => confusion::render_of(&runs()?, source.modality.as_deref()).map(with_remark),
        }
    }
}

impl Drawing {
    /// The same with a remark below everything else, if there is one.
    fn with_remark(mut self, remark: Option<&str>) -> Self {
        if let Some(remark) = remark {
            axes::remark_below(&mut self.page, &plot::plain(remark));
        }
        self
    }

    /// Writes `<folder>/<name>.<format>` for each format.
    ///
    /// # Errors
    /// When the PNG or PDF can't be drawn, or a file can't be written.
    pub fn save(mut self, folder: &Path, name: &str, formats: &[Format]) -> Result<(), FigureError> {
        let svg = self.page.svg();
        for format in formats {
            self.write(&svg, &folder.join(format!("{name}.{}", format.name())), *format)?;
        }
        Ok(())
    }

    /// Writes one file.
    ///
    /// # Errors
    /// When the PNG or PDF can't be drawn, or the file can't be written.
    pub fn save_as(mut self, path: &Path, format: Format) -> Result<(), FigureError> {
        let svg = self.page.svg();
        self.write(&svg, path, format)
    }

    fn write(&mut self, svg: &str, path: &Path, format: Format) -> Result<(), FigureError> {
        match format {
            Format::Svg => write_bytes(path, svg.as_bytes())?,
            Format::Png => write_bytes(path, &Page::png(svg)?)?,
            Format::Pdf => write_bytes(path, &pdf::write(&self.page).map_err(FigureError::Picture)?)?,
            Format::Csv => save(&mut self.data, path)?,
        }
        Ok(())
    }
}
