// Tables: a click on a head sorts by the values behind the cells; empty cells stay last.

function sortable(table) {
  const body = table.tBodies[0], heads = [...table.tHead.rows[0].cells];
  heads.forEach((head, column) => {
    head.querySelector("button")?.addEventListener("click", () => {
      const text = head.dataset.sort === "text", was = head.getAttribute("aria-sort");
      const up = was ? was === "descending" : text;
      heads.forEach((other) => other.removeAttribute("aria-sort"));
      head.setAttribute("aria-sort", up ? "ascending" : "descending");
      const key = (row) => row.cells[column].dataset.value;
      const order = (a, b) => {
        const [x, y] = [key(a), key(b)];
        if (x === undefined || y === undefined) return (x === undefined) - (y === undefined);
        return (text ? x.localeCompare(y) : x - y) * (up ? 1 : -1);
      };
      body.append(...[...body.rows].sort(order));
    });
  });
}
