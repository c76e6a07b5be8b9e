local listed = {}
for _, field in pairs(fields) do table.insert(listed, field) end
proto.fields = listed
proto.experts = {marks.checksum, marks.constant, marks.length, marks.short, marks.skipped, marks.unsure}

-- From here on nothing depends on the sensor: `sensor`, above, says what its frames are made of.

local TWO32 = 4294967296
local library = rawget(_G, "bit32") or rawget(_G, "bit")
local native = library and library.bxor or load("return function(a, b) return a ~ b end")()
local both = library and library.band or load("return function(a, b) return a & b end")()
local function xor32(a, b) return native(a, b) % TWO32 end

-- Integers as Python has them, in what a Lua number holds exactly; used by the formulas of the spec.
function int.bits(a, b, keep)
  local total, weight = 0, 1
  a, b = a % 2 ^ 52, b % 2 ^ 52
  while a > 0 or b > 0 do
    if keep[a % 2 + b % 2] then total = total + weight end
    a, b, weight = math.floor(a / 2), math.floor(b / 2), weight * 2
  end
  return total < 2 ^ 51 and total or total - 2 ^ 52
end
function int.band(a, b) return int.bits(a, b, {[2] = true}) end
function int.bor(a, b) return int.bits(a, b, {[1] = true, [2] = true}) end
function int.bxor(a, b) return int.bits(a, b, {[1] = true}) end
function int.div(a, b) return b ~= 0 and math.floor(a / b) or error("division by zero") end
function int.mod(a, b) return b ~= 0 and a - math.floor(a / b) * b or error("division by zero") end
function int.truth(condition) return condition and 1 or 0 end

-- Checksums: each takes its parameters and the covered bytes as a string.
local WORD32 = {
  size = 32,
  make = function(text) return tonumber(text, 16) end,
  xor = xor32,
  left = function(a, n) return a * 2 ^ n % TWO32 end,
  right = function(a, n) return math.floor(a / 2 ^ n) end,
  low = function(a) return a % 256 end,
}
local WORD64 = {
  size = 64,
  make = function(text) return UInt64.fromhex(text) end,
  xor = function(a, b) return a:bxor(b) end,
  left = function(a, n) return n < 64 and a:lshift(n) or UInt64(0) end,
  right = function(a, n) return n < 64 and a:rshift(n) or UInt64(0) end,
  low = function(a) return a:band(255):tonumber() end,
}

local function odd(word, value) return word.low(value) % 2 == 1 end

local function mirrored(word, value, width)
  local found = word.make("0")
  for place = 0, width - 1 do
    if odd(word, word.right(value, place)) then found = word.xor(found, word.left(word.make("1"), width - 1 - place)) end
  end
  return found
end

local function crc_table(word, crc)
  local entries, poly = {}, word.make(crc.poly)
  poly = crc.refin and mirrored(word, poly, crc.width) or word.left(poly, word.size - crc.width)
  for byte = 0, 255 do
    local value = word.make(string.format("%x", byte))
    if not crc.refin then value = word.left(value, word.size - 8) end
    for _ = 1, 8 do
      local carry
      if crc.refin then carry, value = odd(word, value), word.right(value, 1)
      else carry, value = odd(word, word.right(value, word.size - 1)), word.left(value, 1) end
      if carry then value = word.xor(value, poly) end
    end
    entries[byte] = value
  end
  return entries
end

local checksum = {}
function checksum.crc(crc, data)
  local word = crc.width > 32 and WORD64 or WORD32
  local register = word.make(crc.init)
  crc.entries = crc.entries or crc_table(word, crc)
  register = crc.refin and mirrored(word, register, crc.width) or word.left(register, word.size - crc.width)
  for spot = 1, #data do
    if crc.refin then
      register = word.xor(word.right(register, 8), crc.entries[int.low(xor32(word.low(register), data:byte(spot)))])
    else
      register = word.xor(word.left(register, 8), crc.entries[int.low(xor32(word.low(word.right(register, word.size - 8)), data:byte(spot)))])
    end
  end
  if not crc.refin then register = word.right(register, word.size - crc.width) end
  if crc.refin ~= crc.refout then register = mirrored(word, register, crc.width) end
  return word.xor(register, word.make(crc.xorout))
end
function checksum.sum(sum, data)
  local total = 0
  for spot = 1, #data do total = total + data:byte(spot) end
  return total % 2 ^ sum.width
end
function checksum.xor(_, data)
  local total = 0
  for spot = 1, #data do total = xor32(total, data:byte(spot)) end
  return total
end
function checksum.word_xor(words, data)
  local total, period = {[0] = 0, [1] = 0}, #words.halves
  for spot = 0, #data - 1 do
    local half = spot < words.head and spot % 2 or words.halves[(spot - words.head) % period + 1]
    total[half] = xor32(total[half], data:byte(spot + 1))
  end
  return total[0] + 256 * total[1]
end
function checksum.fletcher(_, data)
  local first, second = 0, 0
  for spot = 1, #data do
    first = (first + data:byte(spot)) % 256
    second = (second + first) % 256
  end
  return first + 256 * second
end
function checksum.fold15(_, data)
  local total, length = 0, #data
  if length % 2 == 1 then data = data .. "\0" end
  for spot = math.max(#data - 60, 0) + 1, #data, 2 do total = total * 2 + data:byte(spot) + 256 * data:byte(spot + 1) end
  return (total % 32768 + math.floor(total / 32768)) % 32768
end
function int.low(value) return value % 256 end

-- Values on the wire.
local function half(raw)
  local sign, exponent, fraction = raw >= 32768 and -1 or 1, math.floor(raw / 1024) % 32, raw % 1024
  if exponent == 31 then return fraction == 0 and sign / 0 or 0 / 0 end
  return sign * (exponent == 0 and fraction * 2 ^ -24 or (1 + fraction / 1024) * 2 ^ (exponent - 15))
end

local function number(node, range)
  local prefix = node.le and "le_" or ""
  if node.type == "float" then
    return node.size == 2 and half(range[prefix .. "uint"](range)) or range[prefix .. "float"](range)
  end
  return range[prefix .. node.type .. (node.size > 4 and "64" or "")](range)
end

local function gathered(part, range)
  local wide = part.width > 52
  local total = wide and UInt64(0) or 0
  for _, segment in ipairs(part.segments) do
    local byte, low, count, target = segment[1], segment[2], segment[3], segment[4]
    local bits = math.floor(range(byte, 1):uint() / 2 ^ low) % 2 ^ count
    if wide then total = total + UInt64(bits):lshift(target) else total = total + bits * 2 ^ target end
  end
  if not wide and part.signed and total >= 2 ^ (part.width - 1) then total = total - 2 ^ part.width end
  if not wide then return math.floor(total) end -- an integer also where Lua tells them from floats
  if not part.signed then return total end
  return Int64(0) + Int64.fromhex(total:lshift(64 - part.width):tohex()):arshift(64 - part.width)
end

local function plain(value) return type(value) == "number" and value or value:tonumber() end

local function physical(node, value)
  local text = string.format("%.10g", plain(value) * (node.scale or 1) + (node.offset or 0))
  return node.unit and text .. " " .. node.unit or text
end

-- A walk through the bytes of one frame. Without `tree` it only measures and checks; with one it shows.
local Walk = {}
Walk.__index = Walk
local step = {}

local function walk(frame, tvb, at, stop)
  return setmetatable({frame = frame, tvb = tvb, start = at, at = at, stop = stop, values = {}, exact = {}, places = {}, items = {}}, Walk)
end

function Walk:fail(verdict) error({verdict = verdict}, 0) end

function Walk:visit(node, tree, label)
  if not tree and node.skip then return self:take(node.skip) end
  return step[node.kind](self, node, tree, label or node.name)
end

-- The next bytes; a frame that is not all there, or longer than it may be, ends here.
function Walk:take(size)
  local from = self.at
  if size ~= size or size < 0 or from + size - self.start > self.frame.longest then self:fail("length") end
  if from + size > self.stop then self:fail("short") end
  self.at = from + size
  return from
end

function Walk:amount(formula)
  local count = type(formula) == "number" and formula or formula(self.values)
  if count ~= count or count < 0 or count > self.frame.longest then self:fail("length") end
  return count
end

local function among(runs, value)
  for _, run in ipairs(runs) do
    if run[1] <= value and value <= run[2] then return true end
  end
  return false
end

function Walk:keep(node, value, from, to, tree)
  if node.keep then
    self.values[node.keep] = type(value) == "string" and value or plain(value)
    self.exact[node.keep], self.places[node.keep] = value, {from, to}
  end
  if (node.const and tostring(value) ~= tostring(node.const)) or (node.allowed and not among(node.allowed, plain(value))) then
    if not tree then self:fail("constant") end
    self.wrong = self.wrong or "constant"
    return false
  end
  return true
end

function Walk:decorate(node, tree, range, item, value, label, right)
  if label ~= node.name then item:set_text(label .. ": " .. (node.labels and node.labels[value] or tostring(value))) end
  if node.unit or node.physical then
    item:append_text(node.physical and " (" .. physical(node, value) .. ")" or " " .. node.unit)
    if node.physical then tree:add(node.physical, range, plain(value) * (node.scale or 1) + (node.offset or 0)):set_hidden(true) end
  end
  if not right then item:add_proto_expert_info(marks.constant) end
  if node.keep then self.items[node.keep] = item end
  if self.summary then table.insert(self.summary, label .. " " .. physical(node, value)) end
end

-- An element of an array says what is in it.
function Walk:sum_up(item)
  if self.summary then item:append_text(": " .. table.concat(self.summary, ", ")) end
end

function step.number(self, node, tree, label)
  local from = self:take(node.size)
  local range = self.tvb(from, node.size)
  local value = number(node, range)
  local right = self:keep(node, value, from, from + node.size, tree)
  if tree then
    local item
    if node.type == "float" and node.size == 2 then item = tree:add(node.field, range, value)
    elseif node.le then item = tree:add_le(node.field, range)
    else item = tree:add(node.field, range) end
    self:decorate(node, tree, range, item, value, label, right)
  end
end

function step.bytes(self, node, tree)
  local size = self:amount(node.size)
  local from = self:take(size)
  local right = self:keep(node, self.tvb:raw(from, size), from, from + size, tree)
  if tree then
    local item = tree:add(node.field, self.tvb(from, size))
    if not right then item:add_proto_expert_info(marks.constant) end
    if node.keep then self.items[node.keep] = item end
  end
end

function step.block(self, node, tree, label)
  local from = self:take(node.size)
  local range = self.tvb(from, node.size)
  local below = tree and node.is_struct and tree:add(proto, range, label) or tree
  for _, part in ipairs(node.parts) do
    local value = gathered(part, range)
    local right = self:keep(part, value, from + part.first, from + part.last + 1, tree)
    if tree then
      local where, item = range(part.first, part.last - part.first + 1), nil
      if part.masked then item = node.le and below:add_le(part.field, range) or below:add(part.field, range)
      else item = below:add(part.field, where, value) end
      self:decorate(part, below, where, item, value, not node.is_struct and label or part.label or part.name, right)
    end
  end
  if tree and node.is_struct then self:sum_up(below) end
end

function step.struct(self, node, tree, label)
  local from, below = self.at, tree
  if tree and label then below = tree:add(proto, self.tvb(from, 0), label) end
  for _, member in ipairs(node.members) do
    local begun = self.at
    self:visit(member, below)
    if member.mark then self.places[member.mark] = {begun, self.at} end
  end
  for _, length in ipairs(node.lengths or {}) do
    if self.values[length.path] ~= length.value(self.values) then
      if not tree then self:fail("constant") end
      self.wrong = self.wrong or "constant"
      self.items[length.path]:add_proto_expert_info(marks.length)
    end
  end
  if below ~= tree then below:set_len(self.at - from) end
  if tree and label then self:sum_up(below) end
end

step["repeat"] = function(self, node, tree, label)
  local count, from = self:amount(node.count), self.at
  if not tree and node.element.skip then return self:take(count * node.element.skip) end
  local below = tree and tree:add(proto, self.tvb(from, 0), string.format("%s: %d", label, count))
  for index = 0, count - 1 do
    local begun, outer = self.at, self.summary
    self.summary = tree and node.summed and {} or nil
    self:visit(node.element, below, tree and string.format("%s[%d]", label, index))
    self.summary = outer
    if self.at == begun then break end -- nothing is in this one, nor in the others
  end
  if below then below:set_len(self.at - from) end
end

-- The first kind whose constants are right.
function Walk:kind(kinds)
  for _, kind in ipairs(kinds) do
    local is_right = true
    for _, mark in ipairs(kind.magic) do
      if self.at + mark[1] >= self.stop then self:fail("short") end
      is_right = is_right and int.band(self.tvb(self.at + mark[1], 1):uint(), mark[2]) == mark[3]
    end
    if is_right then return kind end
  end
  self:fail("constant")
end

function step.parts(self, node, tree, label)
  local from, index = self.at, 0
  local count, next = node.count and self:amount(node.count), node.size and self:amount(node.size)
  local stop = node.within and from + self:amount(node.within)
  local below = tree and tree:add(proto, self.tvb(from, 0), label)
  while (count and index < count) or (next and next > 0) or (stop and self.at < stop) do
    local begun, kind = self.at, self:kind(node.kinds)
    self:visit(kind.element, below, tree and string.format("%s[%d]", label, index))
    local size = self.at - begun
    if size == 0 or (next and next ~= size) or (stop and self.at > stop) then self:fail("length") end
    next = next and self:amount(kind.following)
    index = index + 1
  end
  if node.total then self.values[node.total] = self.at - from end
  if below then below:set_len(self.at - from) end
end

function step.when(self, node, tree, label)
  return self:visit(node.condition(self.values) ~= 0 and node.yes or node.no, tree, label)
end

function step.select(self, node, tree, label)
  return self:visit(node.cases[node.key(self.values)] or node.default, tree, label)
end

function step.empty() end

function step.never(self) self:fail("length") end

function step.check(self, node, tree)
  if node.condition(self.values) ~= 0 then return end
  if not tree then self:fail("constant") end
  self.wrong = self.wrong or "constant"
end

-- What is stored, low bits first, and what should be.
function Walk:stored(declared)
  local total, weight = 0, 1
  for _, held in ipairs(declared.fields) do
    local value = self.values[held.path]
    if type(value) == "string" then
      local number = 0
      for spot = 1, #value do number = number * 256 + value:byte(declared.big and spot or #value + 1 - spot) end
      value = number
    end
    total, weight = total + value % 2 ^ held.width * weight, weight * 2 ^ held.width
  end
  return total
end

function Walk:covered(declared, from)
  if declared.first then return self.tvb:raw(self.places[declared.first][1], self.places[declared.last][2] - self.places[declared.first][1]) end
  local held, parts = {}, {}
  for _, field in ipairs(declared.fields) do table.insert(held, self.places[field.path]) end
  table.sort(held, function(a, b) return a[1] < b[1] end)
  for _, place in ipairs(held) do
    table.insert(parts, place[1] > from and self.tvb:raw(from, place[1] - from) or "")
    from = place[2]
  end
  table.insert(parts, self.at > from and self.tvb:raw(from, self.at - from) or "")
  return table.concat(parts)
end

local function hex(value) return type(value) == "number" and string.format("0x%x", value) or "0x" .. value:tohex() end

function step.checksummed(self, node, tree, label)
  local from = self.at
  self:visit(node.body, tree, label)
  local declared = node.checksum
  local data = self:covered(declared, from)
  if declared.pad then data = data .. string.rep("\0", -#data % declared.pad) end
  local stored, computed = self:stored(declared), checksum[declared.algorithm](declared, data)
  local is_absent = declared.absent[stored]
  local is_right = stored == plain(computed) or is_absent
  if declared.is_wide and type(computed) ~= "number" then
    stored = self.exact[declared.fields[1].path]
    is_right = stored == computed or is_absent
  end
  if not is_right then self.wrong = self.wrong or "checksum" end
  local item = tree and self.items[declared.fields[1].path]
  if item then
    item:append_text(is_absent and " [not filled]" or is_right and " [correct]" or " [wrong, should be " .. hex(computed) .. "]")
    if not is_right then
      item:add_proto_expert_info(marks.checksum, string.format("checksum is %s, should be %s", hex(stored), hex(computed)))
    end
    local place = self.places[declared.fields[1].path]
    item:add(status, self.tvb(place[1], place[2] - place[1]), is_absent and 2 or is_right and 1 or 0):set_generated(true)
  end
end

-- What the bytes at a place are as a frame of one type: "valid", or why not; its size.
local function measured(frame, tvb, at, stop)
  for _, magic in ipairs(frame.magic) do
    if at + magic[1] < stop and both(tvb(at + magic[1], 1):uint(), magic[2]) ~= magic[3] then return "constant", 0 end
  end
  local begun = walk(frame, tvb, at, stop)
  local done, problem = pcall(begun.visit, begun, frame.root)
  if not done then return type(problem) == "table" and problem.verdict or "length", 0 end
  return begun.wrong or "valid", begun.at - at
end

-- Whether a frame type is looked for: some wait until another one was seen, or until nothing is known of what was seen.
local function awaited(frame, last)
  return not frame.after or not last or frame.after == last
end

-- The frame type that bytes are as a whole; it is asked first, since recordings are written frame by frame.
local function exact(tvb, at, stop, last)
  for _, frame in ipairs(sensor.frames) do
    if awaited(frame, last) then
      local verdict, size = measured(frame, tvb, at, stop)
      if verdict == "valid" and size == stop - at then return frame, size end
    end
  end
end

-- The types behind its own that a frame may be as well, where Python decides that, or what announces it was not seen.
local function others(found, tvb, at, size, last)
  local names, first, is_behind = {}, found, false
  for _, frame in ipairs(sensor.frames) do
    if not first.judged and (last or not first.after) then break end
    if is_behind and frame.sent == found.sent and awaited(frame, last) then
      local verdict, length = measured(frame, tvb, at, at + size)
      if verdict == "valid" and length == size then
        table.insert(names, frame.name)
        first = frame
      end
    end
    is_behind = is_behind or frame == found
  end
  return names
end

-- The leftmost valid frame from a place on: place, frame, size. Frames without constants are found at that place only.
local function leftmost(tvb, at, stop, last)
  for place = at, stop - 1 do
    for _, frame in ipairs(sensor.frames) do
      if awaited(frame, last) and (place == at or #frame.magic > 0) then
        local verdict, size = measured(frame, tvb, place, stop)
        if verdict == "valid" and size > 0 then return place, frame, size end
      end
    end
  end
end

-- The first frame type whose constants are right in bytes that are no valid frame, for showing them: type, size, verdict.
local function likely(tvb, at, stop, last)
  for _, frame in ipairs(sensor.frames) do
    if #frame.magic > 0 and awaited(frame, last) then
      local verdict, size = measured(frame, tvb, at, stop)
      if verdict == "checksum" or verdict == "valid" then return frame, size, verdict end
      if verdict == "short" and stop - at > frame.magic[#frame.magic][1] then return frame, stop - at, verdict end
    end
  end
end

-- What is sound and asked for by nobody, neither a tree on the screen nor a filter, is not taken apart.
local function show(frame, tvb, at, size, root, told, is_all_valid, doubts)
  local item = root:add(proto, tvb(at, size), string.format("%s, %s, %d bytes", sensor.title, frame.name, size))
  local shown = item:add(kind, tvb(at, size), frame.name):set_generated(true)
  local named = frame.name
  for _, other in ipairs(doubts or {}) do named = named .. " or " .. other end
  if named ~= frame.name then
    shown:add_proto_expert_info(marks.unsure, named .. ": these bytes do not distinguish the types, or only Python code can")
  end
  if is_all_valid and not root:referenced(Dissector.get(proto.name:lower())) then return table.insert(told, named) end
  local begun = walk(frame, tvb, at, at + size)
  local done, problem = pcall(begun.visit, begun, frame.root, item)
  if not done and type(problem) ~= "table" then error(problem, 0) end
  if not done then item:add_proto_expert_info(marks.short, "the frame ends before its last field") end
  table.insert(told, named .. (not done and " (cut off)" or begun.wrong and " (" .. begun.wrong .. " wrong)" or ""))
end

-- Shows bytes that hold no valid frame; false where nothing in them looks like one.
local function leftover(tvb, at, stop, root, told, last)
  local is_like = false
  while at < stop do
    local frame, length, verdict = likely(tvb, at, stop, last)
    if frame then
      show(frame, tvb, at, length, root, told)
      is_like = verdict
    else
      length = 1
      while at + length < stop and not likely(tvb, at + length, stop, last) do length = length + 1 end
      root:add(proto, tvb(at, length), string.format("%s, %d bytes outside frames", sensor.title, length)):add_proto_expert_info(marks.skipped)
    end
    at = at + length
  end
  return is_like
end

-- The last frame before a packet of those that others wait for, by packet.
local last_before, last_seen = {}, nil

local function dissected(tvb, pinfo, root, is_datagram)
  if not pinfo.visited then last_before[pinfo.number] = last_seen end
  local at, stop, told, last = 0, tvb:len(), {}, last_before[pinfo.number]
  while at < stop do
    local place, frame, size = at, exact(tvb, at, stop, last)
    if not frame then place = nil end
    if not frame and not is_datagram then place, frame, size = leftmost(tvb, at, stop, last) end
    if not frame and #told == 0 and not likely(tvb, at, stop, last) then return 0 end
    if leftover(tvb, at, place or stop, root, told, last) == "short" and not place and pinfo.can_desegment > 0 then
      pinfo.desegment_offset, pinfo.desegment_len = at, DESEGMENT_ONE_MORE_SEGMENT
    end
    if frame then
      show(frame, tvb, place, size, root, told, true, others(frame, tvb, place, size, last))
      if sensor.announcing[frame.name] then last = frame.name end
    end
    at = frame and place + size or stop
  end
  if not pinfo.visited then last_seen = last end
  pinfo.cols.protocol = sensor.title
  pinfo.cols.info = table.concat(told, ", ")
  return stop
end

-- Where another dissector was registered for the same port or link type, it gets what is no frame of ours.
local UDP, TCP = 3, 2
local before = {}

function proto.dissector(tvb, pinfo, root)
  local place = pinfo.port_type == UDP and "udp.port" or pinfo.port_type == TCP and "tcp.port" or "wtap_encap"
  local taken = dissected(tvb, pinfo, root, place == "udp.port" and not sensor.is_stream)
  local other = before[place] and before[place][pinfo.match_uint]
  return taken == 0 and other and other:call(tvb, pinfo, root) or taken
end

for place, patterns in pairs(sensor.places) do
  local known = DissectorTable.get(place)
  before[place] = {}
  for _, pattern in ipairs(patterns) do
    before[place][pattern] = known:get_dissector(pattern)
    known:add(pattern, proto)
  end
end

-- On other ports, a datagram is accepted if it is exactly one frame with constant bytes.
if sensor.has_udp and not sensor.is_stream then
  proto:register_heuristic("udp", function(tvb, pinfo, root)
    local frame = exact(tvb, 0, tvb:len(), last_before[pinfo.number])
    return frame ~= nil and #frame.magic > 1 and dissected(tvb, pinfo, root, true) > 0
  end)
end
