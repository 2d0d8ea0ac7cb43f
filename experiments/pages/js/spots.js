// Spots of a drawing on the line between two of them.

/** All spots from one to another, both included, each beside the one before it. @param {Spot} from @param {Spot} to @returns {Spot[]} */
export function spotsBetween(from, to) {
  const down = to.row - from.row, right = to.column - from.column, num = Math.max(Math.abs(down), Math.abs(right), 1);
  const spots = Array.from({ length: num + 1 }, (_, i) => ({
    row: from.row + Math.round((i * down) / num), column: from.column + Math.round((i * right) / num),
  }));
  return down || right ? spots : [to];
}
