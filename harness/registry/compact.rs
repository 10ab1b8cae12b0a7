//! Copies of the tables of many runs in few files, because opening thousands of files takes longer than reading them.
//!
//! ```text
//! results/compacted/<experiment>/<table>-<hash>.parquet
//! ```
//!
//! A part is a file with the rows of several runs. It lists each run's checksum, and what the file system said of the
//! run's own file. A run's rows are read from a part only if the run's record lists the same checksum and its own file
//! has not changed. Otherwise the run's own file is read, and compared with the record. Parts are written while tables are
//! read, once enough runs are in no part. A damaged part is written again. The folder can be deleted at any time.

use super::folders::sorted;
use super::mark::Mark;
use super::record::{FileRecord, RunRecord};
use super::rows::{Condition, kept};
use super::{Registry, RegistryError};
use harness_shared::files::FolderLock;
use harness_shared::seal::hex;
use harness_tables::schema::{Column, Table};
use harness_tables::{Stamp, TableFile, asked_columns, stacked, write_table};
use polars::prelude::*;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};
use std::any::Any;
use std::collections::{BTreeMap, BTreeSet, HashMap, HashSet};
use std::io::Cursor;
use std::path::PathBuf;

/// The folder of all parts.
const FOLDER: &str = "compacted";
/// The fewest runs of a part: fewer files are as quickly read one by one.
const FEWEST_RUNS: usize = 64;
/// The most runs of a part. One with half as many is not put together with others any more.
const MOST_RUNS: usize = 256;
/// The largest file whose rows are kept: opening a larger one takes little beside reading it.
const LARGEST_BYTES: u64 = 1 << 18;
/// Key of a part's entries in its file's metadata, as JSON.
const RUNS_KEY: &str = "runs";

/// One table over finished runs of one experiment. Its rows are in the order of the runs.
#[derive(Clone)]
pub struct RunTable {
    table: Table,
    /// The folder of the experiment's runs, and that of its parts.
    runs: PathBuf,
    parts: PathBuf,
    files: Vec<RunFile>,
    /// What rows must meet any of, to be read.
    conditions: Arc<BTreeSet<Condition>>,
}

/// A run's file of the table, as its record lists it.
#[derive(Clone)]
struct RunFile {
    run: String,
    listed: FileRecord,
    /// Whether its rows may be kept.
    is_small: bool,
}

/// A run in a part.
#[derive(Debug, Clone, Serialize, Deserialize)]
struct Entry {
    run: String,
    sha256: String,
    rows: usize,
    mark: Mark,
}

/// A file with the rows of several runs, in the order of its entries.
struct Part {
    path: PathBuf,
    file: TableFile,
    entries: Vec<Entry>,
}

/// Rows that lie together: of runs that follow each other in a part, or of one run's own file.
#[derive(Clone, Copy)]
struct Segment {
    place: Place,
    offset: usize,
    rows: usize,
}

#[derive(Clone, Copy, PartialEq)]
enum Place {
    Part(usize),
    File(usize),
}

impl RunTable {
    /// The table over `runs`, all of which must be finished runs of `experiment`.
    ///
    /// Published runs that have no rows of the table have no file of it.
    ///
    /// # Errors
    /// When the record of another run does not list the table's file.
    pub fn new<'a>(
        registry: &Registry,
        table: Table,
        experiment: &str,
        runs: impl Iterator<Item = &'a RunRecord>,
    ) -> Result<Self, RegistryError> {
        let folder = registry.runs().join(experiment);
        let name = table.file_name();
        let runs = runs.filter(|record| record.files.contains_key(&name) || !record.is_published());
        let file = |record: &RunRecord| {
            let listed = record.listed(&folder.join(&record.run), &name)?.clone();
            // Published runs are copies for version control, and few.
            let is_small = listed.bytes <= LARGEST_BYTES && !record.is_published();
            Ok(RunFile { run: record.run.clone(), listed, is_small })
        };
        let files = runs.map(file).collect::<Result<_, RegistryError>>()?;
        let parts = registry.root().join(FOLDER).join(experiment);
        Ok(Self { table, runs: folder, parts, files, conditions: Arc::default() })
    }

    /// The table with only those rows that satisfy at least one of these conditions.
    pub fn only(self, conditions: BTreeSet<Condition>) -> Self {
        Self { conditions: Arc::new(conditions), ..self }
    }

    /// The names and types of the files' columns. Empty if no run has a file of the table.
    ///
    /// # Errors
    /// When the first run's file is damaged.
    pub fn schema(&self) -> PolarsResult<SchemaRef> {
        let columns: Vec<String> = self.table.columns().into_iter().map(|column| column.name).collect();
        let Some(first) = self.files.first() else { return Ok(SchemaRef::default()) };
        Ok(self.read_file(first, &columns)?.schema().clone())
    }

    /// Reads these columns of all rows, or of the first `limit` rows.
    ///
    /// # Errors
    /// When a file is damaged. The error wraps a [`RegistryError`], which [`QueryError`](super::QueryError) unwraps.
    pub fn read(&self, columns: &[String], limit: Option<usize>) -> PolarsResult<DataFrame> {
        let of_conditions: BTreeSet<&String> = self.conditions.iter().flat_map(BTreeMap::keys).collect();
        let others = of_conditions.into_iter().filter(|name| !columns.contains(name));
        let read: Vec<String> = columns.iter().chain(others).cloned().collect();
        let parts = self.map(&read, limit, |rows| kept(rows, &self.conditions)?.select(columns))?;
        Ok(stacked(parts)?.unwrap_or_default())
    }

    /// Applies `of` to these columns, piece by piece, and returns the results in the order of the runs. A piece has all
    /// rows of one or several runs; with a limit, the last piece has fewer.
    ///
    /// # Errors
    /// When a file is damaged, or `of` fails.
    pub fn map<T: Send>(
        &self,
        columns: &[String],
        limit: Option<usize>,
        of: impl Fn(DataFrame) -> PolarsResult<T> + Sync,
    ) -> PolarsResult<Vec<T>> {
        let (parts, places) = self.places();
        let segments = self.segments(&places, limit);
        let cut = |rows: &DataFrame, segment: &Segment| of(rows.slice(segment.offset as i64, segment.rows));
        let of_part = |(number, part): (usize, Part)| -> PolarsResult<Vec<(usize, T)>> {
            let own = segments.iter().enumerate();
            let own: Vec<_> = own.filter(|(_, one)| one.place == Place::Part(number)).collect();
            if own.is_empty() {
                return Ok(Vec::new());
            }
            let rows = part.file.read_serially(columns).map_err(|error| failed(error.into()))?;
            drop(part);
            own.into_iter().map(|(index, segment)| Ok((index, cut(&rows, segment)?))).collect()
        };
        let of_file = |(index, segment): (usize, &Segment)| -> Option<PolarsResult<(usize, T)>> {
            let Place::File(file) = segment.place else { return None };
            let rows = self.read_file(&self.files[file], columns);
            Some(rows.and_then(|rows| Ok((index, cut(&rows, segment)?))))
        };
        let parts: Vec<_> = parts.into_par_iter().enumerate().map(of_part).collect::<PolarsResult<_>>()?;
        let files: Vec<_> =
            segments.par_iter().enumerate().filter_map(of_file).collect::<PolarsResult<_>>()?;
        let mut all: Vec<(usize, T)> = parts.into_iter().flatten().chain(files).collect();
        all.sort_by_key(|(index, _)| *index);
        Ok(all.into_iter().map(|(_, made)| made).collect())
    }

    /// The parts there are, and where in them each run is, if it is in any. Runs that are in none are put into one first,
    /// if there are enough of them.
    fn places(&self) -> (Vec<Part>, Vec<Option<Segment>>) {
        if self.files.len() < FEWEST_RUNS {
            return (Vec::new(), vec![None; self.files.len()]);
        }
        let marks: Vec<Option<Mark>> =
            self.files.par_iter().map(|file| Mark::of(&self.path(&file.run))).collect();
        let parts = self.read_parts();
        let places = self.find(&parts, &marks);
        let loose: Vec<Entry> = (self.files.iter().zip(&marks).zip(&places))
            .filter(|((file, _), place)| file.is_small && place.is_none())
            .filter_map(|((file, mark), _)| Some(file.entry(mark.filter(Mark::is_settled)?)))
            .collect();
        if loose.len() < FEWEST_RUNS || !self.compact(loose) {
            return (parts, places);
        }
        let parts = self.read_parts();
        let places = self.find(&parts, &marks);
        (parts, places)
    }

    fn find(&self, parts: &[Part], marks: &[Option<Mark>]) -> Vec<Option<Segment>> {
        let wanted: HashMap<&str, usize> =
            self.files.iter().enumerate().map(|(index, file)| (file.run.as_str(), index)).collect();
        let mut places = vec![None; self.files.len()];
        for (number, part) in parts.iter().enumerate() {
            let mut offset = 0;
            for entry in &part.entries {
                if let Some(&index) = wanted.get(entry.run.as_str())
                    && self.files[index].listed.sha256 == entry.sha256
                    && marks[index] == Some(entry.mark)
                {
                    places[index] = Some(Segment { place: Place::Part(number), offset, rows: entry.rows });
                }
                offset += entry.rows;
            }
        }
        places
    }

    /// The runs' rows in as few pieces as there are; with a limit, no more than that.
    fn segments(&self, places: &[Option<Segment>], limit: Option<usize>) -> Vec<Segment> {
        let mut segments: Vec<Segment> = Vec::new();
        let mut left = limit.unwrap_or(usize::MAX);
        for (index, (file, place)) in self.files.iter().zip(places).enumerate() {
            // A record of before rows were counted says nothing of them.
            let rows = file.listed.rows.unwrap_or(usize::MAX);
            let own = Segment { place: Place::File(index), offset: 0, rows };
            let mut next = place.unwrap_or(own);
            next.rows = next.rows.min(left);
            if limit.is_some() {
                left -= next.rows;
            }
            // One piece there must be, for its columns.
            let is_needed = next.rows > 0 || segments.is_empty();
            match segments.last_mut() {
                Some(last) if last.place == next.place && last.offset + last.rows == next.offset => {
                    last.rows += next.rows;
                }
                _ if is_needed => segments.push(next),
                _ => {}
            }
        }
        segments
    }

    /// The parts of this table that are whole.
    fn read_parts(&self) -> Vec<Part> {
        let columns = described(&self.table.columns());
        self.part_files().into_par_iter().filter_map(|path| Part::open(path, &columns)).collect()
    }

    /// The files of all parts of this table.
    fn part_files(&self) -> Vec<PathBuf> {
        let prefix = format!("{}-", self.table.name());
        let is_own = |path: &PathBuf| {
            let name = path.file_name().unwrap_or_default().to_string_lossy();
            name.starts_with(&prefix) && name.ends_with(".parquet")
        };
        sorted(&self.parts).into_iter().filter(is_own).collect()
    }

    /// Puts the rows of `loose` runs into parts, together with those of parts that are small, partly outdated or
    /// damaged. Returns whether it did: another process may be at it, and the folder may be read-only or full, all of which
    /// costs time alone.
    fn compact(&self, loose: Vec<Entry>) -> bool {
        let Ok(Some(_lock)) = FolderLock::attempt(&self.parts) else { return false };
        let is_current = |entry: &&Entry| Mark::of(&self.path(&entry.run)) == Some(entry.mark);
        let mut kept = HashSet::new();
        let mut pool: BTreeMap<String, Entry> = BTreeMap::new();
        for part in self.read_parts() {
            let current: Vec<Entry> = part.entries.iter().filter(is_current).cloned().collect();
            if current.len() >= MOST_RUNS / 2 {
                kept.insert(part.path);
            } else {
                pool.extend(current.into_iter().map(|entry| (entry.run.clone(), entry)));
            }
        }
        pool.extend(loose.into_iter().map(|entry| (entry.run.clone(), entry)));
        let pool: Vec<Entry> = pool.into_values().collect();
        let parts = pool.len().div_ceil(MOST_RUNS);
        for runs in pool.chunks(pool.len().div_ceil(parts)) {
            match self.write_part(runs) {
                Ok(path) => drop(kept.insert(path)),
                Err(_) => return false,
            }
        }
        for path in self.part_files().into_iter().filter(|path| !kept.contains(path)) {
            // One that stays takes room and time alone.
            let _ = std::fs::remove_file(path);
        }
        true
    }

    /// Writes a part of these runs, whose own files are read and compared with their checksums.
    fn write_part(&self, runs: &[Entry]) -> PolarsResult<PathBuf> {
        let columns = self.table.columns();
        let names: Vec<String> = columns.iter().map(|column| column.name.clone()).collect();
        let read = |entry: &Entry| -> PolarsResult<(Entry, DataFrame)> {
            let rows = self.read_file(&RunFile::of(entry), &names)?;
            Ok((Entry { rows: rows.height(), ..entry.clone() }, rows))
        };
        let read: Vec<_> = runs.par_iter().map(read).collect::<PolarsResult<_>>()?;
        let (entries, rows): (Vec<Entry>, Vec<DataFrame>) = read.into_iter().unzip();
        let entries = serde_json::to_string(&entries)
            .map_err(|error| PolarsError::ComputeError(error.to_string().into()))?;
        let name = format!("{}-{}.parquet", self.table.name(), hex(&Sha256::digest(&entries)[..8]));
        let path = self.parts.join(name);
        let rows = stacked(rows)?.unwrap_or_default();
        let stamp = Stamp::from([(RUNS_KEY.to_owned(), entries)]);
        write_table(&path, rows, &columns, &stamp).map_err(|error| failed(error.into()))?;
        Ok(path)
    }

    /// These columns of a run's own file, which is compared with its record.
    fn read_file(&self, file: &RunFile, columns: &[String]) -> PolarsResult<DataFrame> {
        let path = self.path(&file.run);
        let bytes = file.listed.read(&path).map_err(failed)?;
        let reader = ParquetReader::new(Cursor::new(bytes)).with_columns(Some(columns.to_vec()));
        // Tables are read side by side; more threads for each would only compete.
        let rows = reader.read_parallel(ParallelStrategy::None).finish();
        let rows = rows.map_err(|error| failed(RegistryError::File { path, reason: error.to_string() }))?;
        rows.select(columns)
    }

    fn path(&self, run: &str) -> PathBuf {
        self.runs.join(run).join(self.table.file_name())
    }
}

/// The table as Polars reads it: the columns that a query asks for.
impl AnonymousScan for RunTable {
    fn as_any(&self) -> &dyn Any {
        self
    }

    fn scan(&self, asked: AnonymousScanArgs) -> PolarsResult<DataFrame> {
        self.read(&asked_columns(&asked), asked.n_rows)
    }

    // Polars filters what it gets. To scans of this kind it would hand its filter in a form that not every filter has.
    fn allows_predicate_pushdown(&self) -> bool {
        false
    }

    fn allows_projection_pushdown(&self) -> bool {
        true
    }
}

impl RunFile {
    fn entry(&self, mark: Mark) -> Entry {
        let (run, sha256) = (self.run.clone(), self.listed.sha256.clone());
        Entry { run, sha256, rows: self.listed.rows.unwrap_or_default(), mark }
    }

    fn of(entry: &Entry) -> Self {
        let listed =
            FileRecord { bytes: entry.mark.bytes, rows: Some(entry.rows), sha256: entry.sha256.clone() };
        Self { run: entry.run.clone(), listed, is_small: true }
    }
}

impl Part {
    /// A part that is whole and has these columns.
    fn open(path: PathBuf, columns: &str) -> Option<Self> {
        let file = TableFile::open(&path).ok()?;
        let footer = file.footer().ok()?;
        let entries: Vec<Entry> = serde_json::from_str(footer.stamp.get(RUNS_KEY)?).ok()?;
        let rows: usize = entries.iter().map(|entry| entry.rows).sum();
        let is_current = footer.stamp.get("columns")? == columns && rows == footer.rows;
        is_current.then_some(Self { path, file, entries })
    }
}

/// The columns as a file's metadata have them.
fn described(columns: &[Column]) -> String {
    serde_json::to_string(columns).unwrap_or_default()
}

/// An error of the registry as one of Polars, as which it passes through a query. `QueryError` finds it again.
fn failed(error: RegistryError) -> PolarsError {
    PolarsError::IO { error: Arc::new(std::io::Error::other(error)), msg: None }
}
