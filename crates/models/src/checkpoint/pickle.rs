//! Reader of Python's pickle format that builds plain values and calls nothing.
//!
//! A pickle is a program for a stack machine. Its values are stored in one list and refer to each other by index, so
//! that sharing and nesting need neither copies nor recursion. Calls of the names in `ACCEPTED` become inert values;
//! any other name is refused. At most `MAX_OPCODES` opcodes are executed (a checkpoint of PointRCNN with its optimiser
//! needs 25,000). This limits memory to about 150 MB, and to about 100 n bytes for a file of n bytes.

use std::collections::HashMap;

const MAX_OPCODES: usize = 1 << 21;

/// Index of a value in its pickle.
pub type Id = u32;

/// One value.
#[derive(Clone, Debug, PartialEq)]
pub enum Value<'a> {
    /// `None`.
    None,
    /// `True` or `False`.
    Bool(bool),
    /// An integer.
    Int(i64),
    /// An integer beyond 64 bits, little-endian two's complement.
    Long(&'a [u8]),
    /// A floating point number.
    Float,
    /// A string.
    Str(&'a str),
    /// Bytes.
    Bytes,
    /// A tuple.
    Tuple(Vec<Id>),
    /// A list.
    List(Vec<Id>),
    /// A `dict` or an `OrderedDict`, in the order of its entries.
    Dict(Vec<(Id, Id)>),
    /// A name of `ACCEPTED`: module and name.
    Global(&'a str, &'a str),
    /// The call of a global with a tuple of arguments.
    Call {
        /// The global.
        callable: Id,
        /// A tuple.
        arguments: Id,
    },
    /// A persistent id; here always a storage.
    Persistent(Id),
}

/// The values of one pickle.
pub struct Pickle<'a> {
    values: Vec<Value<'a>>,
    root: Id,
    /// Length of the pickle at the beginning of the input, bytes.
    pub length: usize,
}

/// Accepted names: module and name. Tensors and dictionaries are interpreted; numpy scalars occur in the state of
/// OpenPCDet's optimiser and stay inert. Storages of `torch` are accepted in addition.
const ACCEPTED: &[(&str, &str)] = &[
    ("torch._utils", "_rebuild_tensor_v2"),
    ("torch._utils", "_rebuild_parameter"),
    ("collections", "OrderedDict"),
    ("numpy.core.multiarray", "scalar"),
    ("numpy._core.multiarray", "scalar"),
    ("numpy", "dtype"),
    ("_codecs", "encode"),
];

impl<'a> Pickle<'a> {
    /// Reads the pickle at the beginning of `bytes`.
    pub fn parse(bytes: &'a [u8]) -> Result<Self, String> {
        let mut machine = Machine { bytes, at: 0, values: vec![], stack: vec![], marks: vec![], memo: HashMap::new() };
        match machine.run() {
            Ok(root) => Ok(Pickle { values: machine.values, root, length: machine.at }),
            Err(message) => Err(format!("pickle, byte {}: {message}", machine.at)),
        }
    }

    /// The root value.
    pub fn root(&self) -> &Value<'a> {
        self.get(self.root)
    }

    /// A value.
    pub fn get(&self, id: Id) -> &Value<'a> {
        &self.values[id as usize] // only `push` creates ids
    }

    /// Every value, in the order of creation.
    pub fn values(&self) -> &[Value<'a>] {
        &self.values
    }
}

struct Machine<'a> {
    bytes: &'a [u8],
    at: usize,
    values: Vec<Value<'a>>,
    stack: Vec<Id>,
    marks: Vec<usize>,
    memo: HashMap<u32, Id>,
}

impl<'a> Machine<'a> {
    fn run(&mut self) -> Result<Id, String> {
        for _ in 0..MAX_OPCODES {
            let opcode = self.byte()?;
            if opcode == b'.' {
                let root = self.pop()?;
                return if self.stack.is_empty() && self.marks.is_empty() {
                    Ok(root)
                } else {
                    Err("ends too early".into())
                };
            }
            self.step(opcode)?;
        }
        Err(format!("has more than {MAX_OPCODES} instructions"))
    }

    fn step(&mut self, opcode: u8) -> Result<(), String> {
        match opcode {
            0x80 => match self.byte()? {
                2..=5 => Ok(()),
                other => Err(format!("unknown protocol {other}")),
            },
            0x95 => self.take(8).map(drop), // a frame; its length is not needed
            b'N' => self.push(Value::None),
            0x88 => self.push(Value::Bool(true)),
            0x89 => self.push(Value::Bool(false)),
            b'K' => {
                let n = self.byte()?;
                self.push(Value::Int(n.into()))
            }
            b'M' => {
                let n = u16::from_le_bytes(self.array()?);
                self.push(Value::Int(n.into()))
            }
            b'J' => {
                let n = i32::from_le_bytes(self.array()?);
                self.push(Value::Int(n.into()))
            }
            0x8a => {
                let length = self.byte()?;
                self.long(length.into())
            }
            0x8b => {
                let length = self.u32()?;
                self.long(length)
            }
            b'G' => {
                self.take(8)?;
                self.push(Value::Float)
            }
            b'X' => {
                let length = self.u32()?;
                self.text(length)
            }
            0x8c => {
                let length = self.byte()?;
                self.text(length.into())
            }
            b'B' => {
                let length = self.u32()?;
                self.take(length)?;
                self.push(Value::Bytes)
            }
            b'C' => {
                let length = self.byte()?;
                self.take(length.into())?;
                self.push(Value::Bytes)
            }
            b'(' => {
                self.marks.push(self.stack.len());
                Ok(())
            }
            b')' => self.push(Value::Tuple(vec![])),
            b't' => {
                let items = self.pop_to_mark()?;
                self.push(Value::Tuple(items))
            }
            0x85..=0x87 => {
                let items = self.pop_many(usize::from(opcode - 0x84))?;
                self.push(Value::Tuple(items))
            }
            b']' => self.push(Value::List(vec![])),
            b'a' => {
                let item = self.pop()?;
                self.append(vec![item])
            }
            b'e' => {
                let items = self.pop_to_mark()?;
                self.append(items)
            }
            b'}' => self.push(Value::Dict(vec![])),
            b's' => {
                let items = self.pop_many(2)?;
                self.set_items(&items)
            }
            b'u' => {
                let items = self.pop_to_mark()?;
                self.set_items(&items)
            }
            b'c' => {
                let (module, name) = (self.line()?, self.line()?);
                self.global(module, name)
            }
            0x93 => {
                let names = self.pop_many(2)?;
                match (&self.values[names[0] as usize], &self.values[names[1] as usize]) {
                    (Value::Str(module), Value::Str(name)) => self.global(module, name),
                    _ => Err("has a global without a name".into()),
                }
            }
            b'R' => self.reduce(),
            b'b' => self.build(),
            b'Q' => {
                let id = self.pop()?;
                self.push(Value::Persistent(id))
            }
            b'q' => {
                let key = self.byte()?;
                self.memoize(key.into())
            }
            b'r' => {
                let key = u32::from_le_bytes(self.array()?);
                self.memoize(key)
            }
            0x94 => self.memoize(self.memo.len() as u32),
            b'h' => {
                let key = self.byte()?;
                self.recall(key.into())
            }
            b'j' => {
                let key = u32::from_le_bytes(self.array()?);
                self.recall(key)
            }
            other => Err(format!("instruction {other:#04x} is not one that torch writes")),
        }
    }

    fn push(&mut self, value: Value<'a>) -> Result<(), String> {
        self.stack.push(self.values.len() as Id); // at most MAX_OPCODES values
        self.values.push(value);
        Ok(())
    }

    /// Pops a value above the last mark; values below it belong to another object.
    fn pop(&mut self) -> Result<Id, String> {
        if self.stack.len() <= self.marks.last().copied().unwrap_or(0) {
            return Err("pops from an empty stack".into());
        }
        self.stack.pop().ok_or_else(|| "pops from an empty stack".into())
    }

    fn pop_many(&mut self, count: usize) -> Result<Vec<Id>, String> {
        let mut items = (0..count).map(|_| self.pop()).collect::<Result<Vec<_>, _>>()?;
        items.reverse();
        Ok(items)
    }

    fn pop_to_mark(&mut self) -> Result<Vec<Id>, String> {
        let mark = self.marks.pop().ok_or("closes a list that was not opened")?;
        Ok(self.stack.split_off(mark))
    }

    fn top(&mut self) -> Result<&mut Value<'a>, String> {
        let id = self.pop()?;
        self.stack.push(id);
        Ok(&mut self.values[id as usize])
    }

    fn append(&mut self, mut items: Vec<Id>) -> Result<(), String> {
        match self.top()? {
            Value::List(list) => {
                list.append(&mut items);
                Ok(())
            }
            _ => Err("appends to a value that is not a list".into()),
        }
    }

    fn set_items(&mut self, items: &[Id]) -> Result<(), String> {
        let (pairs, rest) = items.as_chunks::<2>();
        match self.top()? {
            Value::Dict(entries) if rest.is_empty() => {
                entries.extend(pairs.iter().map(|[key, value]| (*key, *value)));
                Ok(())
            }
            _ => Err("adds entries to a value that is not a dictionary, or half an entry".into()),
        }
    }

    fn global(&mut self, module: &'a str, name: &'a str) -> Result<(), String> {
        let storage = module == "torch" && storage_width(name).is_some();
        if !storage && !ACCEPTED.contains(&(module, name)) {
            return Err(format!(
                "asks for {module}.{name}, which a checkpoint of weights does not need; the file is refused"
            ));
        }
        self.push(Value::Global(module, name))
    }

    fn reduce(&mut self) -> Result<(), String> {
        let arguments = self.pop()?;
        let callable = self.pop()?;
        match (&self.values[callable as usize], &self.values[arguments as usize]) {
            (Value::Global("collections", "OrderedDict"), Value::Tuple(none)) if none.is_empty() => {
                self.push(Value::Dict(vec![]))
            }
            (Value::Global("collections", "OrderedDict"), _) => Err("has an OrderedDict with arguments".into()),
            (Value::Global(..), Value::Tuple(_)) => self.push(Value::Call { callable, arguments }),
            _ => Err("calls a name that is not accepted, or without a tuple of arguments".into()),
        }
    }

    /// Attributes of an object (versions in a `state_dict`, the byte order of a numpy type) are ignored.
    fn build(&mut self) -> Result<(), String> {
        self.pop()?;
        match self.top()? {
            Value::Dict(_) | Value::Call { .. } => Ok(()),
            _ => Err("sets attributes of a plain value".into()),
        }
    }

    fn memoize(&mut self, key: u32) -> Result<(), String> {
        let id = self.pop()?;
        self.stack.push(id);
        self.memo.insert(key, id);
        Ok(())
    }

    fn recall(&mut self, key: u32) -> Result<(), String> {
        let id = self.memo.get(&key).ok_or_else(|| format!("reads memo {key}, which was not stored"))?;
        self.stack.push(*id);
        Ok(())
    }

    fn long(&mut self, length: usize) -> Result<(), String> {
        let bytes = self.take(length)?;
        let negative = bytes.last().is_some_and(|b| b & 0x80 != 0);
        let mut wide = [if negative { 0xff } else { 0 }; 8];
        match wide.get_mut(..length) {
            Some(low) => {
                low.copy_from_slice(bytes);
                self.push(Value::Int(i64::from_le_bytes(wide)))
            }
            None => self.push(Value::Long(bytes)),
        }
    }

    fn text(&mut self, length: usize) -> Result<(), String> {
        let text = utf8(self.take(length)?)?;
        self.push(Value::Str(text))
    }

    fn line(&mut self) -> Result<&'a str, String> {
        let rest = &self.bytes[self.at..];
        let length = rest.iter().position(|&b| b == b'\n').ok_or("ends inside a name")?;
        self.at += length + 1;
        utf8(&rest[..length])
    }

    fn byte(&mut self) -> Result<u8, String> {
        Ok(self.take(1)?[0])
    }

    fn u32(&mut self) -> Result<usize, String> {
        Ok(u32::from_le_bytes(self.array()?) as usize)
    }

    fn array<const N: usize>(&mut self) -> Result<[u8; N], String> {
        self.take(N).map(|bytes| std::array::from_fn(|i| bytes[i]))
    }

    fn take(&mut self, length: usize) -> Result<&'a [u8], String> {
        let rest = &self.bytes[self.at..];
        let taken = rest.get(..length).ok_or_else(|| format!("needs {length} bytes, {} are left", rest.len()))?;
        self.at += length;
        Ok(taken)
    }
}

fn utf8(bytes: &[u8]) -> Result<&str, String> {
    std::str::from_utf8(bytes).map_err(|_| "holds a string that is not UTF-8".into())
}

/// Element size of a storage of torch, bytes.
pub fn storage_width(name: &str) -> Option<usize> {
    match name {
        "DoubleStorage" | "LongStorage" => Some(8),
        "FloatStorage" | "IntStorage" => Some(4),
        "HalfStorage" | "BFloat16Storage" | "ShortStorage" => Some(2),
        "CharStorage" | "ByteStorage" | "BoolStorage" => Some(1),
        _ => None,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn error(bytes: &[u8]) -> String {
        Pickle::parse(bytes).err().expect("should be refused")
    }

    #[test]
    fn plain_values() {
        let pickle =
            Pickle::parse(b"\x80\x02}q\x00(X\x01\x00\x00\x00aK\x05X\x01\x00\x00\x00b]q\x01(M\x00\x01h\x00eu.rest")
                .unwrap();
        assert_eq!(pickle.length, 32);
        let Value::Dict(entries) = pickle.root() else { panic!() };
        assert_eq!(entries.len(), 2);
        assert_eq!((pickle.get(entries[0].0), pickle.get(entries[0].1)), (&Value::Str("a"), &Value::Int(5)));
        let Value::List(items) = pickle.get(entries[1].1) else { panic!() };
        assert_eq!(pickle.get(items[0]), &Value::Int(256));
        assert_eq!(pickle.get(items[1]), pickle.root(), "a value may contain itself");
    }

    #[test]
    fn whole_numbers() {
        for (bytes, want) in [
            (&b"\x8a\x00."[..], 0),
            (b"\x8a\x01\xff.", -1),
            (b"\x8a\x02\x00\x01.", 256),
            (b"\x8a\x08\xff\xff\xff\xff\xff\xff\xff\x7f.", i64::MAX),
            (b"J\xfe\xff\xff\xff.", -2),
        ] {
            assert_eq!(Pickle::parse(bytes).unwrap().root(), &Value::Int(want));
        }
        let long = Pickle::parse(b"\x8a\x09\x00\x00\x00\x00\x00\x00\x00\x00\x01.").unwrap();
        assert_eq!(long.root(), &Value::Long(&[0, 0, 0, 0, 0, 0, 0, 0, 1]));
    }

    #[test]
    fn code_is_refused_by_name() {
        for bytes in [
            &b"cos\nsystem\n(X\x02\x00\x00\x00lstR."[..],
            b"\x80\x04\x8c\x02os\x94\x8c\x06system\x94\x93.",
            b"cposix\nsystem\n.",
            b"cbuiltins\neval\n.",
            b"ctorch\nload\n.",
            b"ctorch._utils\nFloatStorage\n.",
        ] {
            assert!(error(bytes).contains("asks for "), "{}", error(bytes));
        }
        assert!(error(b"cos\nsystem\n.").contains("asks for os.system"));
        assert!(error(b"(ios\nsystem\n.").contains("instruction 0x69"));
        assert!(error(b"X\x02\x00\x00\x00ls)R.").contains("not accepted"));
    }

    #[test]
    fn broken_programs() {
        for bytes in [
            &b""[..],
            b".",
            b"N",
            b"NN.",
            b"(N.",
            b"t.",
            b"(Na.",
            b"]Nu.",
            b"}Ns.",
            b"}(Nu.",
            b"h\x00.",
            b"X\xff\xff\xff\xffabc.",
            b"X\x01\x00\x00\x00\xff.",
            b"ctorch",
            b"\x80\x09N.",
            b"N(0.",
            b"N}b.",
            b"N(b.",
        ] {
            error(bytes);
        }
        assert!(error(&[b'('; MAX_OPCODES + 5]).contains("more than"));
        // Deep nesting causes no recursion, neither in reading nor in dropping.
        let mut deep = vec![b']'; 1_000_000];
        deep.extend(vec![b'a'; 999_999]);
        deep.push(b'.');
        assert!(Pickle::parse(&deep).is_ok());
    }
}
