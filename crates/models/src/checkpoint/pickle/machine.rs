//! The stack machine that executes a pickle.

use super::{Contents, Id, Value};
use std::collections::HashMap;

pub(super) struct Machine<'a> {
    contents: Contents,
    bytes: &'a [u8],
    at: usize,
    values: Vec<Value<'a>>,
    stack: Vec<Id>,
    marks: Vec<usize>,
    memo: HashMap<u32, Id>,
}

impl<'a> Machine<'a> {
    /// Executes the pickle at the beginning of `bytes`: all values, the root, and the length of the pickle.
    pub(super) fn run(bytes: &'a [u8], contents: Contents) -> Result<(Vec<Value<'a>>, Id, usize), String> {
        let (values, stack, marks) = (Vec::new(), Vec::new(), Vec::new());
        let mut machine = Machine { contents, bytes, at: 0, values, stack, marks, memo: HashMap::new() };
        match machine.root() {
            Ok(root) => Ok((machine.values, root, machine.at)),
            Err(message) => Err(format!("pickle, byte {}: {message}", machine.at)),
        }
    }

    fn root(&mut self) -> Result<Id, String> {
        for _ in 0..self.contents.max_opcodes() {
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
        Err(format!("has more than {} instructions", self.contents.max_opcodes()))
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
                let number = f64::from_be_bytes(self.array()?);
                self.push(Value::Float(number))
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
                self.bytes(length)
            }
            b'C' => {
                let length = self.byte()?;
                self.bytes(length.into())
            }
            // Bytes and an array of bytes, with a long length.
            0x8e | 0x96 => {
                let length = self.u64()?;
                self.bytes(length)
            }
            0x8d => {
                let length = self.u64()?;
                self.text(length)
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
            other => Err(format!("instruction {other:#04x} is not part of {}", self.contents.noun())),
        }
    }

    fn push(&mut self, value: Value<'a>) -> Result<(), String> {
        if self.values.len() >= self.contents.max_values() {
            return Err(format!("has more than {} values", self.contents.max_values()));
        }
        self.stack.push(self.values.len() as Id);
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
        if !self.contents.accepts(module, name) {
            return Err(format!(
                "asks for {module}.{name}, which {} does not need; the file is refused",
                self.contents.noun()
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
            (Value::Global(..), Value::Tuple(_)) => self.push(Value::Call { callable, arguments, state: None }),
            _ => Err("calls a name that is not accepted, or without a tuple of arguments".into()),
        }
    }

    /// Attributes of a dictionary (versions in a `state_dict`) are ignored. The state of an object (the byte order of a
    /// numpy type, the content of an array) is kept.
    fn build(&mut self) -> Result<(), String> {
        let of_object = self.pop()?;
        match self.top()? {
            Value::Dict(_) => Ok(()),
            Value::Call { state, .. } => {
                *state = Some(of_object);
                Ok(())
            }
            _ => Err("sets attributes of a plain value".into()),
        }
    }

    fn memoize(&mut self, key: u32) -> Result<(), String> {
        let id = self.pop()?;
        self.stack.push(id);
        if self.memo.len() >= self.contents.max_values() {
            return Err(format!("has more than {} memo entries", self.contents.max_values()));
        }
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

    fn bytes(&mut self, length: usize) -> Result<(), String> {
        let bytes = self.take(length)?;
        self.push(Value::Bytes(bytes))
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

    fn u64(&mut self) -> Result<usize, String> {
        let length = u64::from_le_bytes(self.array()?);
        usize::try_from(length).map_err(|_| format!("needs {length} bytes"))
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
