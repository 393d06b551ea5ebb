//! Arrays of numpy in a pickle, as numpy 1 and 2 write them with every protocol of Python 3.
//!
//! - `_reconstruct(ndarray, (0,), b"b")` with the state `(version, shape, dtype, fortran order, content)`
//! - `_frombuffer(content, dtype, shape, order)`, protocol 5
//! - `scalar(dtype, content)`
//!
//! The content is bytes, or, with protocol 2, `_codecs.encode(text, "latin1")`. Its length is checked against shape and
//! type before elements are read.

use crate::checkpoint::pickle::{Id, Pickle, Value};
use std::borrow::Cow;

/// Largest number of dimensions.
const MAX_DIMENSIONS: usize = 8;

/// An array with its content as in the file.
pub(super) struct Array<'p> {
    pickle: &'p Pickle<'p>,
    element: Element,
    /// Dimensions; empty for a scalar.
    pub shape: Vec<usize>,
    /// Whether the first index varies fastest.
    fortran: bool,
    content: Content<'p>,
}

/// Type of the elements.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Element {
    F16,
    F32,
    F64,
    /// Signed, with this many bytes.
    Int(usize),
    /// Unsigned, with this many bytes.
    Unsigned(usize),
    /// Text with this many characters of 4 bytes, filled up with zeros.
    Unicode(usize),
    /// Text with this many bytes, filled up with zeros.
    Ascii(usize),
    /// Values of Python.
    Object,
}

enum Content<'p> {
    Raw(Cow<'p, [u8]>),
    Objects(&'p [Id]),
}

impl<'p> Array<'p> {
    /// The array, list or scalar of numpy with this id; `None` if it is another value.
    pub fn of(pickle: &'p Pickle<'p>, id: Id) -> Result<Option<Self>, String> {
        let objects = |items: &'p Vec<Id>| {
            Some(Array {
                pickle,
                element: Element::Object,
                shape: vec![items.len()],
                fortran: false,
                content: Content::Objects(items),
            })
        };
        let (name, arguments, state) = match pickle.get(id) {
            Value::List(items) | Value::Tuple(items) => return Ok(objects(items)),
            Value::Call { callable, arguments, state } => match (pickle.get(*callable), pickle.get(*arguments)) {
                (Value::Global(_, name), Value::Tuple(arguments)) => (*name, arguments.as_slice(), *state),
                _ => return Ok(None),
            },
            _ => return Ok(None),
        };
        let (shape, dtype, fortran, content) = match (name, arguments, state) {
            ("_reconstruct", _, Some(state)) => match pickle.get(state) {
                Value::Tuple(parts) => match parts[..] {
                    [_, shape, dtype, fortran, content] => {
                        (Some(shape), dtype, *pickle.get(fortran) == Value::Bool(true), content)
                    }
                    _ => return Err("is an array whose state is not as numpy writes it".into()),
                },
                _ => return Err("is an array whose state is not as numpy writes it".into()),
            },
            ("_frombuffer", &[content, dtype, shape, order], None) => {
                (Some(shape), dtype, *pickle.get(order) == Value::Str("F"), content)
            }
            ("scalar", &[dtype, content], None) => (None, dtype, false, content),
            ("_reconstruct" | "_frombuffer" | "scalar", ..) => {
                return Err("is an array that is not as numpy writes it".into());
            }
            _ => return Ok(None),
        };
        let shape = shape.map_or(Ok(Vec::new()), |shape| dimensions(pickle, shape))?;
        let element = Element::of(pickle, dtype)?;
        let content = match (element, pickle.get(content)) {
            (Element::Object, Value::List(items)) => Content::Objects(items),
            _ => Content::Raw(raw(pickle, content)?),
        };
        let array = Array { pickle, element, shape, fortran, content };
        array.check()?;
        Ok(Some(array))
    }

    /// Checks that the content has exactly the size of shape and type.
    fn check(&self) -> Result<(), String> {
        let count = self.shape.iter().try_fold(1usize, |n, extent| n.checked_mul(*extent));
        let (found, width) = match &self.content {
            Content::Raw(bytes) => (bytes.len(), self.element.width()),
            Content::Objects(items) => (items.len(), 1),
        };
        match count.and_then(|count| count.checked_mul(width)) {
            Some(wanted) if wanted == found && (width > 0 || count == Some(0)) => Ok(()),
            _ => Err(format!("is an array of shape {:?} whose content has another size; it is damaged", self.shape)),
        }
    }

    /// Number of elements.
    fn len(&self) -> usize {
        self.shape.iter().product()
    }

    /// The numbers in row-major order.
    pub fn numbers(&self) -> Result<Vec<f64>, String> {
        let values: Vec<f64> = match &self.content {
            Content::Objects(items) => items
                .iter()
                .map(|id| match self.pickle.get(*id) {
                    Value::Int(n) => Ok(*n as f64),
                    Value::Float(v) => Ok(*v),
                    _ => match Array::of(self.pickle, *id)? {
                        Some(one) if one.shape.is_empty() && one.element != Element::Object => {
                            one.numbers().map(|values| values[0])
                        }
                        _ => Err("contains a value that is not a number".to_string()),
                    },
                })
                .collect::<Result<_, _>>()?,
            Content::Raw(bytes) => self.element.numbers(bytes)?,
        };
        let mut columns = self.shape.iter().copied();
        match (self.fortran, columns.next(), columns.next(), columns.next()) {
            (true, Some(rows), Some(columns), None) => {
                Ok((0..values.len()).map(|i| values[i % columns * rows + i / columns]).collect())
            }
            (true, _, _, Some(_)) => Err("is an array of three dimensions in Fortran's order".into()),
            _ => Ok(values),
        }
    }

    /// The texts. An empty array of numbers has none: OpenPCDet writes it for a frame without detections.
    pub fn texts(&self) -> Result<Vec<String>, String> {
        if self.len() == 0 {
            return Ok(Vec::new());
        }
        match (&self.content, self.element) {
            (Content::Objects(items), _) => items
                .iter()
                .map(|id| text(self.pickle, *id)?.ok_or_else(|| "contains a value that is not a text".to_string()))
                .collect(),
            (Content::Raw(bytes), Element::Unicode(characters)) => bytes
                .chunks_exact(4 * characters)
                .map(|chunk| {
                    let codes = chunk.as_chunks::<4>().0.iter().map(|b| u32::from_le_bytes(*b)).take_while(|c| *c != 0);
                    let text: Option<String> = codes.map(char::from_u32).collect();
                    text.ok_or_else(|| "contains a text that is not Unicode".to_string())
                })
                .collect(),
            (Content::Raw(bytes), Element::Ascii(length)) => bytes
                .chunks_exact(length)
                .map(|chunk| {
                    let text: Vec<u8> = chunk.iter().copied().take_while(|b| *b != 0).collect();
                    String::from_utf8(text).map_err(|_| "contains a text that is not UTF-8".to_string())
                })
                .collect(),
            _ => Err("holds numbers instead of texts".into()),
        }
    }
}

/// The text with this id: of Python, or a scalar of numpy; `None` if it is another value.
pub(super) fn text(pickle: &Pickle, id: Id) -> Result<Option<String>, String> {
    match pickle.get(id) {
        Value::Str(text) => return Ok(Some((*text).into())),
        Value::List(_) | Value::Tuple(_) => return Ok(None),
        _ => {}
    }
    match Array::of(pickle, id)? {
        Some(one) if one.shape.is_empty() && matches!(one.element, Element::Unicode(_) | Element::Ascii(_)) => {
            Ok(one.texts()?.pop())
        }
        _ => Ok(None),
    }
}

impl Element {
    /// `dtype(name, False, True)` with the state `(3, byte order, None, None, None, size, alignment, flags)`.
    fn of(pickle: &Pickle, dtype: Id) -> Result<Self, String> {
        let damaged = || String::from("has a type that is not as numpy writes it");
        let Value::Call { callable, arguments, state } = pickle.get(dtype) else { return Err(damaged()) };
        let (Value::Global("numpy", "dtype"), Value::Tuple(arguments)) =
            (pickle.get(*callable), pickle.get(*arguments))
        else {
            return Err(damaged());
        };
        let Some(Value::Str(name)) = arguments.first().map(|id| pickle.get(*id)) else { return Err(damaged()) };
        if let Some(state) = state {
            let Value::Tuple(parts) = pickle.get(*state) else { return Err(damaged()) };
            if parts.get(1).map(|id| pickle.get(*id)) == Some(&Value::Str(">")) {
                return Err("is big-endian, which is not supported; save it on a little-endian machine".into());
            }
        }
        let kind = name.chars().next().ok_or_else(damaged)?;
        let size = name.get(kind.len_utf8()..).and_then(|size| size.parse::<usize>().ok());
        match (kind, size) {
            ('f', Some(2)) => Ok(Element::F16),
            ('f', Some(4)) => Ok(Element::F32),
            ('f', Some(8)) => Ok(Element::F64),
            ('i', Some(size @ (1 | 2 | 4 | 8))) => Ok(Element::Int(size)),
            ('u', Some(size @ (1 | 2 | 4 | 8))) | ('b', Some(size @ 1)) => Ok(Element::Unsigned(size)),
            ('U', Some(length)) if length < 1 << 20 => Ok(Element::Unicode(length)),
            ('S', Some(length)) if length < 1 << 20 => Ok(Element::Ascii(length)),
            ('O', _) => Ok(Element::Object),
            _ => Err(format!("has elements of the type {name:?}; numbers and texts are supported")),
        }
    }

    /// Bytes of an element.
    fn width(self) -> usize {
        match self {
            Element::F16 => 2,
            Element::F32 => 4,
            Element::F64 => 8,
            Element::Int(size) | Element::Unsigned(size) | Element::Ascii(size) => size,
            Element::Unicode(length) => 4 * length,
            Element::Object => 1,
        }
    }

    /// The numbers of little-endian bytes.
    fn numbers(self, bytes: &[u8]) -> Result<Vec<f64>, String> {
        let wide = |chunk: &[u8], fill: u8| {
            let mut wide = [fill; 8];
            wide[..chunk.len()].copy_from_slice(chunk);
            wide
        };
        let whole = |chunk: &[u8]| {
            let negative = chunk.last().is_some_and(|b| b & 0x80 != 0);
            i64::from_le_bytes(wide(chunk, if negative { 0xff } else { 0 })) as f64
        };
        Ok(match self {
            Element::F16 => bytes.as_chunks::<2>().0.iter().map(|b| half(u16::from_le_bytes(*b))).collect(),
            Element::F32 => bytes.as_chunks::<4>().0.iter().map(|b| f32::from_le_bytes(*b).into()).collect(),
            Element::F64 => bytes.as_chunks::<8>().0.iter().map(|b| f64::from_le_bytes(*b)).collect(),
            Element::Int(size) => bytes.chunks_exact(size).map(whole).collect(),
            Element::Unsigned(size) => {
                bytes.chunks_exact(size).map(|chunk| u64::from_le_bytes(wide(chunk, 0)) as f64).collect()
            }
            Element::Unicode(_) | Element::Ascii(_) | Element::Object => {
                return Err("holds texts instead of numbers".into());
            }
        })
    }
}

/// The value of a half-precision number.
pub(super) fn half(bits: u16) -> f64 {
    let (exponent, fraction) = (i32::from(bits >> 10 & 0x1f), f64::from(bits & 0x3ff) / 1024.0);
    let size = match exponent {
        0 => fraction * 2f64.powi(-14),
        0x1f if fraction == 0.0 => f64::INFINITY,
        0x1f => f64::NAN,
        _ => (1.0 + fraction) * 2f64.powi(exponent - 15),
    };
    if bits >> 15 == 1 { -size } else { size }
}

fn dimensions(pickle: &Pickle, shape: Id) -> Result<Vec<usize>, String> {
    let extent = |id: &Id| match pickle.get(*id) {
        Value::Int(n) => usize::try_from(*n).ok(),
        _ => None,
    };
    let shape: Option<Vec<usize>> = match pickle.get(shape) {
        Value::Tuple(extents) if extents.len() <= MAX_DIMENSIONS => extents.iter().map(extent).collect(),
        _ => None,
    };
    shape.ok_or_else(|| "is an array whose shape is damaged".into())
}

/// Bytes of Python, or `_codecs.encode(text, "latin1")`, or `bytes()`.
fn raw<'p>(pickle: &'p Pickle<'p>, id: Id) -> Result<Cow<'p, [u8]>, String> {
    let damaged = || String::from("is an array whose content is not bytes");
    match pickle.get(id) {
        Value::Bytes(bytes) => Ok(Cow::Borrowed(bytes)),
        Value::Call { callable, arguments, .. } => match (pickle.get(*callable), pickle.get(*arguments)) {
            (Value::Global(_, "bytes"), Value::Tuple(none)) if none.is_empty() => Ok(Cow::Borrowed(&[])),
            (Value::Global("_codecs", "encode"), Value::Tuple(arguments)) => {
                let [text, coding] = arguments[..] else { return Err(damaged()) };
                let (Value::Str(text), Value::Str("latin1" | "latin-1")) = (pickle.get(text), pickle.get(coding))
                else {
                    return Err(damaged());
                };
                let bytes: Option<Vec<u8>> = text.chars().map(|c| u8::try_from(u32::from(c)).ok()).collect();
                bytes.map(Cow::Owned).ok_or_else(damaged)
            }
            _ => Err(damaged()),
        },
        _ => Err(damaged()),
    }
}
