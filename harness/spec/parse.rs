//! Parses YAML text into a tree in which every value has its place in the text.

use super::error::{Origin, Problem, SpecError};
use serde::de::{Deserialize, Deserializer, MapAccess, SeqAccess, Visitor};
use serde_yaml::options::NonFiniteFloatPolicy;
use serde_yaml::{MessageFormatter, Spanned, UserMessageFormatter};
use std::fmt;
use std::fs::File;
use std::io::Read;
use std::path::Path;

/// Size of the largest file that is read, bytes.
pub(super) const MAX_FILE_BYTES: u64 = 1 << 20;

/// A YAML value and where it was written.
#[derive(Debug, Clone)]
pub(super) struct Node {
    pub origin: Origin,
    pub value: Value,
}

/// A YAML value; a mapping is called a section.
#[derive(Debug, Clone)]
pub(super) enum Value {
    Null,
    Bool(bool),
    Integer(i128),
    Float(f64),
    Text(String),
    List(Vec<Node>),
    Section(Vec<Entry>),
}

/// One `key: value` of a section.
#[derive(Debug, Clone)]
pub(super) struct Entry {
    pub key: String,
    pub key_origin: Origin,
    pub node: Node,
}

impl Node {
    /// Returns the value of `key`; `None` if this is not a section, or lacks the key.
    pub fn get(&self, key: &str) -> Option<&Node> {
        match &self.value {
            Value::Section(entries) => entries.iter().find(|entry| entry.key == key).map(|entry| &entry.node),
            _ => None,
        }
    }

    /// Like [`Node::get`], but mutable.
    pub fn get_mut(&mut self, key: &str) -> Option<&mut Node> {
        match &mut self.value {
            Value::Section(entries) => {
                entries.iter_mut().find(|entry| entry.key == key).map(|entry| &mut entry.node)
            }
            _ => None,
        }
    }

    /// Returns where the value at a dotted path was written. If it is missing, returns the place of the innermost
    /// section around it. A number in the path is an index into a list. A key may contain dots.
    pub fn origin_of(&self, path: &str) -> &Origin {
        if path.is_empty() {
            return &self.origin;
        }
        let below = |key: &str| match path.strip_prefix(key)? {
            "" => Some(""),
            rest => rest.strip_prefix('.'),
        };
        let child = match &self.value {
            Value::List(items) => {
                let (index, rest) = path.split_once('.').unwrap_or((path, ""));
                index.parse().ok().and_then(|index: usize| Some((items.get(index)?, rest)))
            }
            Value::Section(entries) => {
                entries.iter().find_map(|entry| Some((&entry.node, below(&entry.key)?)))
            }
            _ => None,
        };
        child.map_or(&self.origin, |(child, rest)| child.origin_of(rest))
    }

    /// Returns the value with `origin` as the place of all its parts.
    pub fn attributed_to(mut self, origin: &Origin) -> Node {
        self.origin = origin.clone();
        self.value = match self.value {
            Value::List(items) => {
                Value::List(items.into_iter().map(|item| item.attributed_to(origin)).collect())
            }
            Value::Section(entries) => Value::Section(
                entries
                    .into_iter()
                    .map(|entry| Entry {
                        key: entry.key,
                        key_origin: origin.clone(),
                        node: entry.node.attributed_to(origin),
                    })
                    .collect(),
            ),
            scalar => scalar,
        };
        self
    }

    /// Returns a JSON value as a node with `origin` as the place of all its parts.
    pub fn of_json(json: &serde_json::Value, origin: &Origin) -> Self {
        let value = match json {
            serde_json::Value::Null => Value::Null,
            serde_json::Value::Bool(value) => Value::Bool(*value),
            serde_json::Value::Number(number) => match number.as_i128() {
                Some(integer) => Value::Integer(integer),
                None => Value::Float(number.as_f64().unwrap_or(f64::NAN)),
            },
            serde_json::Value::String(text) => Value::Text(text.clone()),
            serde_json::Value::Array(items) => {
                Value::List(items.iter().map(|item| Self::of_json(item, origin)).collect())
            }
            serde_json::Value::Object(entries) => {
                let entry = |(key, value): (&String, _)| Entry {
                    key: key.clone(),
                    key_origin: origin.clone(),
                    node: Self::of_json(value, origin),
                };
                Value::Section(entries.iter().map(entry).collect())
            }
        };
        Self { origin: origin.clone(), value }
    }

    /// Returns the value as JSON. A number that JSON cannot hold becomes null, so check the tree first.
    pub fn to_json(&self) -> serde_json::Value {
        match &self.value {
            Value::Null => serde_json::Value::Null,
            Value::Bool(value) => (*value).into(),
            Value::Integer(value) => serde_json::Number::from_i128(*value).into(),
            Value::Float(value) => (*value).into(),
            Value::Text(value) => value.as_str().into(),
            Value::List(items) => items.iter().map(Node::to_json).collect(),
            Value::Section(entries) => {
                entries.iter().map(|entry| (entry.key.clone(), entry.node.to_json())).collect()
            }
        }
    }
}

impl fmt::Display for Value {
    /// Writes the value as it appears after "found" in a message.
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        match self {
            Value::Null => write!(f, "nothing"),
            Value::Bool(value) => write!(f, "{value}"),
            Value::Integer(value) => write!(f, "{value}"),
            Value::Float(value) => write!(f, "{value:?}"),
            Value::Text(text) => write!(f, "the text '{}'", shorten(text)),
            Value::List(items) if items.is_empty() => write!(f, "an empty list"),
            Value::List(items) => write!(f, "a list of {}", items.len()),
            Value::Section(_) => write!(f, "a section of keys"),
        }
    }
}

/// Shortens a text to 60 characters on one line, to quote it in a message. Characters that can't be printed are
/// escaped.
pub(super) fn shorten(text: &str) -> String {
    const LONGEST: usize = 60;
    let mut shown = String::new();
    for letter in text.chars().take(LONGEST) {
        match letter {
            '\'' | '"' | '\\' => shown.push(letter),
            other => shown.extend(other.escape_debug()),
        }
    }
    if text.chars().nth(LONGEST).is_some() { shown + "…" } else { shown }
}

/// Reads the text of a YAML file.
///
/// # Errors
/// When the file is missing, is a directory or an MJCF model, is larger than 1 MiB, can't be read, or is not UTF-8.
pub fn read(path: &Path) -> Result<String, SpecError> {
    let unreadable = |message: String| SpecError::Unreadable { path: path.display().to_string(), message };
    if path.is_dir() {
        return Err(unreadable("is a directory; name a YAML file in it".into()));
    }
    let file = File::open(path).map_err(|error| match error.kind() {
        std::io::ErrorKind::NotFound => unreadable("there is no such file".into()),
        _ => unreadable(format!("can't be opened: {error}")),
    })?;
    if path.extension().is_some_and(|ending| ending.eq_ignore_ascii_case("xml")) {
        return Err(unreadable(
            "is an MJCF model; `harness world new MODEL.xml` writes a world file for it".into(),
        ));
    }
    let mut bytes = Vec::new();
    // Reading one byte more than allowed detects a file that is too large, even a pipe, whose metadata has no size.
    file.take(MAX_FILE_BYTES + 1)
        .read_to_end(&mut bytes)
        .map_err(|error| unreadable(format!("can't be read: {error}")))?;
    if bytes.len() as u64 > MAX_FILE_BYTES {
        return Err(unreadable("is larger than 1 MiB; it must be a short text".into()));
    }
    String::from_utf8(bytes).map_err(|error| {
        let valid = &error.as_bytes()[..error.utf8_error().valid_up_to()];
        let line = valid.iter().filter(|&&byte| byte == b'\n').count() + 1;
        unreadable(format!("is not UTF-8 text: the first bad byte is on line {line}"))
    })
}

/// Parses one YAML document.
pub(super) fn parse(text: &str) -> Result<Node, Problem> {
    let options = serde_yaml::options! {
        with_snippet: false,
        strict_booleans: true,
        non_finite_float_policy: NonFiniteFloatPolicy::PassThrough,
        // A spec is small. A document that exceeds these limits is a mistake, or an attack with nested aliases.
        budget: serde_yaml::budget! { max_depth: 16, max_nodes: 100_000 },
        alias_limits: serde_yaml::alias_limits! { max_total_replayed_events: 10_000 },
    };
    serde_yaml::from_str_with_options(text, options).map_err(|error| {
        let origin = error.location().map_or(Origin::START, Origin::at);
        let message = UserMessageFormatter.format_message(error.without_snippet());
        Problem { origin, message: format!("broken YAML: {message}") }
    })
}

impl<'de> Deserialize<'de> for Node {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        let spanned = Spanned::<Value>::deserialize(deserializer)?;
        Ok(Node { origin: Origin::at(spanned.referenced), value: spanned.value })
    }
}

impl<'de> Deserialize<'de> for Value {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        deserializer.deserialize_any(ValueVisitor)
    }
}

struct ValueVisitor;

impl<'de> Visitor<'de> for ValueVisitor {
    type Value = Value;

    fn expecting(&self, f: &mut fmt::Formatter) -> fmt::Result {
        write!(f, "a YAML value")
    }

    fn visit_unit<E>(self) -> Result<Value, E> {
        Ok(Value::Null)
    }

    fn visit_bool<E>(self, value: bool) -> Result<Value, E> {
        Ok(Value::Bool(value))
    }

    fn visit_i64<E>(self, value: i64) -> Result<Value, E> {
        Ok(Value::Integer(value.into()))
    }

    fn visit_u64<E>(self, value: u64) -> Result<Value, E> {
        Ok(Value::Integer(value.into()))
    }

    fn visit_f64<E>(self, value: f64) -> Result<Value, E> {
        Ok(Value::Float(value))
    }

    fn visit_str<E>(self, value: &str) -> Result<Value, E> {
        Ok(Value::Text(value.to_owned()))
    }

    fn visit_seq<A: SeqAccess<'de>>(self, mut items: A) -> Result<Value, A::Error> {
        let mut list = Vec::new();
        while let Some(item) = items.next_element()? {
            list.push(item);
        }
        Ok(Value::List(list))
    }

    fn visit_map<A: MapAccess<'de>>(self, mut entries: A) -> Result<Value, A::Error> {
        let mut section = Vec::new();
        while let Some((key, node)) = entries.next_entry::<Spanned<String>, Node>()? {
            section.push(Entry { key: key.value, key_origin: Origin::at(key.referenced), node });
        }
        Ok(Value::Section(section))
    }
}
