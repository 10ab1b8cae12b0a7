//! Parses YAML text into a tree in which every value has its place in the text.

use super::{Place, Problem};
use serde::de::{Deserialize, Deserializer, MapAccess, SeqAccess, Visitor};
use serde_yaml::options::NonFiniteFloatPolicy;
use serde_yaml::{MessageFormatter, Spanned, UserMessageFormatter};
use std::fmt;

/// A YAML value and where it was written.
#[derive(Debug, Clone)]
pub struct Node {
    /// Where it was written.
    pub place: Place,
    /// The value.
    pub value: Value,
}

/// A YAML value; a mapping is called a section.
#[derive(Debug, Clone)]
pub enum Value {
    /// Nothing.
    Null,
    /// `true` or `false`.
    Bool(bool),
    /// An integer.
    Integer(i128),
    /// A number with a fraction or an exponent.
    Float(f64),
    /// A text.
    Text(String),
    /// A sequence.
    List(Vec<Node>),
    /// A mapping.
    Section(Vec<Entry>),
}

/// One `key: value` of a section.
#[derive(Debug, Clone)]
pub struct Entry {
    /// The key.
    pub key: String,
    /// Where the key was written.
    pub key_place: Place,
    /// The value and its place.
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
    pub fn place_of(&self, path: &str) -> &Place {
        match self.below(path) {
            Some((child, rest)) => child.place_of(rest),
            None => &self.place,
        }
    }

    /// Returns the numbers, counted from 1, of the items that a dotted path leads through in lists of several items.
    pub fn items_on(&self, path: &str) -> Vec<usize> {
        let Some((child, rest)) = self.below(path) else { return Vec::new() };
        let own = match &self.value {
            Value::List(items) if items.len() > 1 => items.iter().position(|item| std::ptr::eq(item, child)),
            _ => None,
        };
        own.map(|index| index + 1).into_iter().chain(child.items_on(rest)).collect()
    }

    /// Returns the part of this value to which a dotted path leads first, and the rest of the path.
    fn below<'a>(&self, path: &'a str) -> Option<(&Node, &'a str)> {
        if path.is_empty() {
            return None;
        }
        let below = |key: &str| match path.strip_prefix(key)? {
            "" => Some(""),
            rest => rest.strip_prefix('.'),
        };
        match &self.value {
            Value::List(items) => {
                let (index, rest) = path.split_once('.').unwrap_or((path, ""));
                index.parse().ok().and_then(|index: usize| Some((items.get(index)?, rest)))
            }
            Value::Section(entries) => {
                entries.iter().find_map(|entry| Some((&entry.node, below(&entry.key)?)))
            }
            _ => None,
        }
    }

    /// Returns the value with `place` as the place of all its parts.
    #[must_use]
    pub fn attributed_to(self, place: &Place) -> Node {
        self.placed(&|_| place.clone())
    }

    /// Returns the value with the places that `place` makes of the places of its parts.
    #[must_use]
    pub fn placed(self, place: &impl Fn(&Place) -> Place) -> Node {
        let entry = |entry: Entry| Entry {
            key: entry.key,
            key_place: place(&entry.key_place),
            node: entry.node.placed(place),
        };
        let value = match self.value {
            Value::List(items) => Value::List(items.into_iter().map(|item| item.placed(place)).collect()),
            Value::Section(entries) => Value::Section(entries.into_iter().map(entry).collect()),
            scalar => scalar,
        };
        Node { place: place(&self.place), value }
    }

    /// Returns a JSON value as a node with `place` as the place of all its parts.
    pub fn of_json(json: &serde_json::Value, place: &Place) -> Self {
        let value = match json {
            serde_json::Value::Null => Value::Null,
            serde_json::Value::Bool(value) => Value::Bool(*value),
            serde_json::Value::Number(number) => match number.as_i128() {
                Some(integer) => Value::Integer(integer),
                None => Value::Float(number.as_f64().unwrap_or(f64::NAN)),
            },
            serde_json::Value::String(text) => Value::Text(text.clone()),
            serde_json::Value::Array(items) => {
                Value::List(items.iter().map(|item| Self::of_json(item, place)).collect())
            }
            serde_json::Value::Object(entries) => {
                let entry = |(key, value): (&String, _)| Entry {
                    key: key.clone(),
                    key_place: place.clone(),
                    node: Self::of_json(value, place),
                };
                Value::Section(entries.iter().map(entry).collect())
            }
        };
        Self { place: place.clone(), value }
    }

    /// Returns the value as JSON. An integer beyond 64 bits becomes the nearest float. A float that is not finite becomes
    /// null, so check the tree first.
    pub fn to_json(&self) -> serde_json::Value {
        match &self.value {
            Value::Null => serde_json::Value::Null,
            Value::Bool(value) => (*value).into(),
            Value::Integer(value) => match serde_json::Number::from_i128(*value) {
                Some(number) => number.into(),
                None => (*value as f64).into(),
            },
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
            Value::Section(entries) if entries.is_empty() => write!(f, "an empty section"),
            Value::Section(_) => write!(f, "a section of keys"),
        }
    }
}

/// Shortens a text to 60 characters on one line, to quote it in a message. Characters that can't be printed are
/// escaped.
pub fn shorten(text: &str) -> String {
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

/// Parses one YAML document.
///
/// # Errors
/// When the text is not valid YAML, or is nested too deeply.
pub fn parse(text: &str) -> Result<Node, Problem> {
    let options = serde_yaml::options! {
        with_snippet: false,
        strict_booleans: true,
        non_finite_float_policy: NonFiniteFloatPolicy::PassThrough,
        // A spec is small. A document that exceeds these limits is a mistake, or an attack with nested aliases.
        budget: serde_yaml::budget! { max_depth: 16, max_nodes: 100_000 },
        alias_limits: serde_yaml::alias_limits! { max_total_replayed_events: 10_000 },
    };
    serde_yaml::from_str_with_options(text, options).map_err(|error| {
        let place = error.location().map_or(Place::START, Place::at);
        let message = UserMessageFormatter.format_message(error.without_snippet());
        Problem { place, message: format!("broken YAML: {message}") }
    })
}

impl<'de> Deserialize<'de> for Node {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        let spanned = Spanned::<Value>::deserialize(deserializer)?;
        Ok(Node { place: Place::at(spanned.referenced), value: spanned.value })
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
            section.push(Entry { key: key.value, key_place: Place::at(key.referenced), node });
        }
        Ok(Value::Section(section))
    }
}
