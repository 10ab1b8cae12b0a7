"""Uses the page of `harness serve` in a real headless Chromium like a person: filters, sorts, groups, chooses, asks.

    use_serve.py HARNESS RESULTS CHROMIUM CHROMEDRIVER [--hostile] [--many] [--horizon] [--settings] [--live SPEC]
        [--screenshots DIR]

The results may be of any robot. With --hostile, names on the page try to run scripts that set `window.hostile`, and
only that is checked. With --many, the times and the memory of many runs are measured too. With --settings, the runs
differ in the learning rate, and plots over it are checked. With --live, a run of the spec is started and removed while
the page is open, and the page must follow. Ends with an error at the first thing that is wrong.
"""

import argparse
import json
import re
import signal
import subprocess
import tempfile
import time
import urllib.error
import urllib.request
from pathlib import Path

from read_page import DESKTOP, PHONE, open_browser
from selenium import webdriver
from selenium.common.exceptions import StaleElementReferenceException
from selenium.webdriver.common.action_chains import ActionChains
from selenium.webdriver.common.by import By
from selenium.webdriver.common.keys import Keys
from selenium.webdriver.support.ui import Select, WebDriverWait

PATIENCE_S = 300
# The smallest width and height of what is clicked or touched, px (WCAG 2.2, 2.5.8).
TARGET = 24


class Served:
    """The page in the browser."""

    def __init__(self, browser: webdriver.Chrome, address: str, screenshots: Path | None):
        self.browser, self.address, self.screenshots = browser, address, screenshots

    def open(self, size: tuple[int, int]):
        width, height = size
        self.browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", {
            "width": width, "height": height, "deviceScaleFactor": 1, "mobile": size == PHONE})
        start = time.monotonic()
        self.browser.get(self.address)
        # The browser remembers 250 requests, and the page asks for changes again and again.
        self.browser.execute_script("performance.setResourceTimingBufferSize(100000)")
        self.wait(lambda: self.count() is not None)
        return time.monotonic() - start

    def wait(self, condition):
        # The page may replace what was just found.
        ignored = [StaleElementReferenceException]
        waiting = WebDriverWait(self.browser, PATIENCE_S, poll_frequency=0.02, ignored_exceptions=ignored)
        waiting.until(lambda _: condition())

    def one(self, selector: str):
        return self.browser.find_element(By.CSS_SELECTOR, selector)

    def all(self, selector: str):
        return self.browser.find_elements(By.CSS_SELECTOR, selector)

    def text(self, selector: str) -> str:
        return self.browser.execute_script("return document.querySelector(arguments[0])?.textContent ?? \"\"", selector)

    def texts(self, selector: str) -> list[str]:
        script = "return [...document.querySelectorAll(arguments[0])].map((one) => one.textContent)"
        return self.browser.execute_script(script, selector)

    def count(self) -> list[int] | None:
        """The number of runs that match the filter, and that of all runs."""
        found = re.fullmatch(r"(\d+) of (\d+) runs", self.text("#count"))
        return [int(number) for number in found.groups()] if found else None

    def filter(self, text: str) -> float:
        """Types a filter, and returns the milliseconds until the table shows its answer."""
        script = """
            const [text, done] = arguments;
            const field = document.getElementById("filter");
            const start = performance.now();
            field.value = text;
            field.dispatchEvent(new Event("input"));
            requestAnimationFrame(() => requestAnimationFrame(() => done(performance.now() - start)));"""
        return self.browser.execute_async_script(script, text)

    def column(self, name: str) -> list[str]:
        """The visible cells of a column."""
        names = [re.sub(r" [↑↓▲▼]", "", text) for text in self.texts("#table thead th")]
        place = names.index(name) + 1
        return self.texts(f"#table tbody tr:not([aria-hidden]) td:nth-child({place})")

    def toggle(self, name: str):
        """Shows a column, or hides it if it is shown."""
        script = """
            const labels = [...document.querySelectorAll("#choice label")];
            labels.find((label) => label.textContent.trim() === arguments[0]).querySelector("input").click();"""
        self.browser.execute_script(script, name)

    def sort(self, name: str):
        for button in self.all("#table thead button"):
            if re.sub(r" [↑↓▲▼]", "", button.text) == name:
                self.browser.execute_script("arguments[0].click()", button)
                return
        raise AssertionError(f"there is no column {name}")

    def answered(self, path: str) -> int:
        """The number of requests of this path that the server has answered."""
        requests = "performance.getEntriesByType('resource')"
        script = f"return {requests}.filter(({{name}}) => name.includes(arguments[0])).length"
        return self.browser.execute_script(script, path)

    def click_row(self, place: int = 0, times: int = 1):
        """Clicks a run in the table. Several clicks come before the server can answer the first one."""
        script = """
            const rows = () => document.querySelectorAll("#table tbody tr:not([aria-hidden])");
            for (let click = 0; click < arguments[1]; click += 1) rows()[arguments[0]].click();"""
        self.browser.execute_script(script, place, times)

    def metric(self) -> str:
        """The first column of an R2 that a run has, or else of a relative error."""
        names = [re.sub(r" [↑↓▲▼]", "", text) for text in self.texts("#table thead th")]
        there = [name for name in names if set(self.column(name)) != {"–"}]
        return next(name for end in (" r2", " relative_error") for name in there if name.endswith(end))

    def shoot(self, name: str):
        if self.screenshots:
            self.browser.save_screenshot(str(self.screenshots / f"{name}.png"))

    def check_quiet(self):
        """No script failed, and nothing was asked of any other server."""
        # A wrong query is answered with an error, which the browser logs.
        complaints = [entry for entry in self.browser.get_log("browser")
                      if entry["level"] == "SEVERE" and "/api/sql" not in entry["message"]]
        assert not complaints, complaints
        for entry in self.browser.get_log("performance"):
            message = json.loads(entry["message"])["message"]
            if message["method"] == "Network.requestWillBeSent":
                url = message["params"]["request"]["url"]
                assert url.startswith((self.address, "data:", "about:", "chrome")), url


def ask(address: str, path: str, headers: dict[str, str] | None = None, body: str | None = None) -> tuple[int, str]:
    """The status and the text of an answer."""
    data = None if body is None else body.encode()
    request = urllib.request.Request(address + path, data, headers or {})
    try:
        with urllib.request.urlopen(request) as answer:
            return answer.status, answer.read().decode()
    except urllib.error.HTTPError as error:
        return error.code, error.read().decode()


def check_guard(address: str):
    """Only this machine's own page and programs are answered, and nothing can be written."""
    port = address.rsplit(":", 1)[1]
    for headers in [{"Host": "evil.example"}, {"Host": f"evil.example:{port}"}, {"Origin": "http://evil.example"},
                    {"Origin": "null"}, {"Sec-Fetch-Site": "cross-site"}]:
        status, text = ask(address, "/api/runs", headers)
        assert (status, text) == (403, "only pages of this server may ask it"), (headers, status, text)
    link = {"Sec-Fetch-Site": "cross-site", "Sec-Fetch-Mode": "navigate", "Sec-Fetch-Dest": "document"}
    assert ask(address, "/", link)[0] == 200, "a link from another site may be followed"
    frame, rebound = link | {"Sec-Fetch-Dest": "iframe"}, link | {"Host": "evil.example"}
    for path, headers in [("/api/runs", link), ("/", frame), ("/", rebound)]:
        assert ask(address, path, headers)[0] == 403, (path, headers)
    for headers in [{}, {"Host": f"localhost:{port}"}, {"Host": f"[::1]:{port}"}, {"Origin": address}]:
        assert ask(address, "/api/tables", headers)[0] == 200, headers
    assert ask(address, "/api/nothing")[0] == 404
    assert ask(address, "/../../etc/passwd")[0] == 404
    assert ask(address, "/api/runs", body="x")[0] == 405
    assert ask(address, "/api/run")[0] == 400
    assert ask(address, "/api/run?run=a/b") == (404, "there is no run a/b")
    status, text = ask(address, "/api/sql", body="delete from runs")
    assert status == 400 and "the query can't be answered" in text, text
    assert ask(address, "/api/sql", body=f"select count(*) as n from runs where run != '{'a' * 1_000_000}'")[0] == 200
    status, text = ask(address, "/api/sql", body=" " * 2_000_000)
    assert status == 400 and "the query can't be answered" in text, text
    tables = [path for path in (Path("/proc/net/tcp"), Path("/proc/net/tcp6")) if path.exists()]
    sockets = [line.split() for table in tables for line in table.read_text().splitlines()[1:]]
    # Addresses are hexadecimal, and 0A means that the socket listens.
    own = [socket[1] for socket in sockets if socket[3] == "0A" and socket[1].endswith(f":{int(port):04X}")]
    assert own == [f"0100007F:{int(port):04X}"], own


def check_runs(page: Served):
    page.open(DESKTOP)
    found, everything = page.count()
    assert found == everything > 0
    page.shoot("runs")
    name = page.column("run")[0]
    page.filter(f'"{name}"')
    assert page.count()[0] >= 1 and all(name in text for text in page.column("run"))
    page.filter("latent>3 status=done")
    done = page.count()[0]
    assert done > 0 and set(page.column("status")) == {"done"}
    page.filter("nothing=3")
    assert page.text("#note") == "there is no column nothing"
    page.one("#tab-sql").click()
    shown = page.one("body").text
    assert "Query" in shown and "there is no column" not in shown, "a message stays on its own tab"
    page.one("#tab-runs").click()
    assert "there is no column nothing" in page.one("body").text
    page.filter("no such run")
    assert page.count()[0] == 0
    page.filter("status=done")
    metric = page.metric()
    of_kinds = [name for name in page.texts("#choice label") if name.strip() == "contact_force r2_ground"]
    for _ in of_kinds:
        page.toggle("contact_force r2_ground")
    arrows = {text[:-2].strip(): text[-1] for text in page.texts("#table thead th") if text[-1:] in ("↑", "↓")}
    assert {arrow for name, arrow in arrows.items() if " r2" in name} <= {"↑"}, arrows
    assert arrows[metric] == ("↑" if metric.endswith(" r2") else "↓"), arrows
    assert {arrow for name, arrow in arrows.items() if " r2" not in name} <= {"↓"}, arrows
    for _ in of_kinds:
        assert arrows["contact_force r2_ground"] == "↑", arrows
        page.toggle("contact_force r2_ground")
    page.sort(metric)
    values = [float(text.replace("−", "-")) for text in page.column(metric) if text != "–"]
    assert values == sorted(values, reverse=True), values
    Select(page.one("#group")).select_by_visible_text("experiment")
    groups = page.texts("#table tr.group")
    assert groups and sum(int(re.search(r"\((\d+)\)", text)[1]) for text in groups) == page.count()[0]
    table = page.text("#table")
    assert not any(int(re.search(r"\((\d+)\)", text)[1]) > 1 for text in groups) or "±" in table, table
    Select(page.one("#plotted")).select_by_value(metric)
    chart = page.one("#plot .plot")
    assert chart.get_attribute("aria-label").startswith(f"{metric} by experiment: "), "the metric is plotted"
    chart.send_keys(Keys.HOME)
    assert page.text("#plot .tooltip") != "", "a point says what it is"
    page.shoot("groups")
    check_address(page)
    page.browser.execute_script("document.querySelector('#table tr.group').click()")
    assert len(page.texts("#table tbody tr:not(.group):not([aria-hidden])")) > 0
    Select(page.one("#group")).select_by_value("")
    assert page.text("#plot") == "", "without groups there is no plot"


def check_address(page: Served):
    """A link has the filter, the order, the groups, the plot and the chosen runs."""
    def state() -> list:
        fields = [page.one(f"#{name}").get_property("value") for name in ("filter", "group", "plotted")]
        return [*fields, page.count(), page.texts("#table tr.group"), page.texts("#table thead th")]
    before, address = state(), page.browser.current_url
    assert "#filter=" in address and "group=experiment" in address, address
    page.browser.get("about:blank")
    page.browser.get(address)
    page.browser.execute_script("performance.setResourceTimingBufferSize(100000)")
    page.wait(lambda: page.count() is not None)
    assert state() == before and page.browser.current_url == address, (before, state())


def check_comparison(page: Served, harness: str, results: str):
    """The table of an experiment is that of `harness compare`, and one of its rows is drawn."""
    page.open(DESKTOP)
    name = page.texts("#compared option")[1]
    assert page.answered("/api/compare") == 0, "a table is made when it is asked for"
    Select(page.one("#compared")).select_by_value(name)
    page.wait(lambda: page.all("#comparison tbody tr"))
    path = f"/api/compare?experiment={name}"
    tables = json.loads(ask(page.address, path)[1])["tables"]
    columns = [column["name"] for column in tables[0]["columns"]]
    assert page.texts("#comparison div:nth-of-type(3) thead th")[2:] == columns, columns
    metrics = "smape,wmape,r2,rmse,mae,relative_error,skill"
    command = [harness, "--results", results, "compare", name, "--metrics", metrics, "--format", "markdown"]
    said = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    lines = [line.strip("| ").split(" | ") for line in said.splitlines() if line.startswith("|")]
    compared = {cell.replace("*", "") for line in lines for cell in line}
    assert set(columns) <= compared, (columns, said)
    cells = [cell["text"] for table in tables for row in table["rows"] for cell in row["cells"] if cell]
    assert cells and set(cells) <= compared, (set(cells) - compared, said)
    assert len(page.all("#comparison b")) == sum(cell.startswith("**") for line in lines for cell in line)
    rows = page.texts("#comparison select option")
    assert len(rows) == sum(len(table["rows"]) for table in tables) == len(set(rows)), rows
    Select(page.one("#comparison select")).select_by_value(rows[-1])
    chart = page.one("#comparison .plot")
    assert chart.get_attribute("aria-label").startswith(f"{rows[-1]}: "), rows
    chart.send_keys(Keys.HOME)
    last = tables[-1]["rows"][-1]["cells"]
    first = next(place for place, cell in enumerate(last) if cell)
    assert page.text("#comparison .tooltip span") == f"{columns[first]}: {last[first]['text']}"
    page.browser.execute_script("document.querySelector('#comparison').scrollIntoView()")
    page.shoot("comparison")
    address = page.browser.current_url
    page.browser.get("about:blank")
    page.browser.get(address)
    page.wait(lambda: page.all("#comparison tbody tr"))
    assert page.one("#comparison .plot").get_attribute("aria-label").startswith(f"{rows[-1]}: ")
    Select(page.one("#compared")).select_by_value("")
    page.wait(lambda: page.text("#comparison") == "")


def check_chosen(page: Served):
    asked = page.answered("/api/run?")
    page.click_row(times=2)
    page.wait(lambda: page.answered("/api/run?") == asked + 1)
    assert not page.all("tr.chosen") and page.text("#chosen") == "", "the second click takes the run away"
    for place in range(2):
        page.click_row(place)
        page.wait(lambda place=place: len(page.all("#chosen .uplot")) > 0 and len(page.all("tr.chosen")) == place + 1)
    page.wait(lambda: page.text("#chosen h2") == "2 runs")
    assert "Settings that differ" in page.text("#chosen")
    chart = page.one("#chosen .plot")
    page.browser.execute_script("arguments[0].scrollIntoView({block: 'center'})", chart)
    page.shoot("chosen")
    tooltip = page.one("#chosen .tooltip")
    chart.send_keys(Keys.END)
    last = tooltip.text
    chart.send_keys(Keys.HOME)
    first = tooltip.text
    assert first != last and first.startswith("epoch 1\n") and last.startswith("epoch "), (first, last)
    # The values of both runs, each on two splits.
    assert len(first.splitlines()) == 5, first
    script = "const box = arguments[0].getBoundingClientRect(); return [box.x + 8, box.y + 8]"
    ring = page.browser.execute_script(script, page.one("#chosen .ring"))
    chart.send_keys(Keys.ESCAPE)
    assert not tooltip.is_displayed()
    pointer = ActionChains(page.browser).w3c_actions
    pointer.pointer_action.move_to_location(*map(round, ring))
    pointer.perform()
    page.wait(tooltip.is_displayed)
    assert tooltip.text.startswith("epoch 1\n"), tooltip.text
    entry = page.one("#chosen .legend button")
    page.browser.execute_script("arguments[0].click()", entry)
    assert entry.get_attribute("aria-pressed") == "false"
    chart.send_keys(Keys.HOME)
    assert entry.text not in tooltip.text and len(tooltip.text.splitlines()) == 4, tooltip.text
    page.browser.execute_script("for (const one of document.querySelectorAll('#chosen details')) one.open = true")
    page.shoot("details")
    directions = page.browser.execute_script("""
        const all = [...document.querySelectorAll("#chosen details")];
        const rows = all.find((one) => one.textContent.startsWith("Metrics")).querySelectorAll("tbody tr");
        return Object.fromEntries([...rows].map(({cells}) => [cells[2].textContent, cells[5].textContent]));""")
    is_up = {name: words == "higher is better" for name, words in directions.items()}
    higher = ("r2", "log_r2", "trimmed_r2", "f1", "auc")
    assert is_up == {name: name.startswith(higher) for name in directions}, directions
    for _ in range(2):
        page.browser.execute_script("document.querySelector('tr.chosen').click()")
    page.wait(lambda: page.text("#chosen") == "")


def check_order(page: Served, question):
    """The answer to the last query is shown, also if that to an earlier one arrives later."""
    page.browser.execute_script("""
        const real = window.fetch;
        window.fetch = async (...request) => {
          if (request[0] !== "/api/sql") return real(...request);
          window.fetch = real;
          const answer = await real(...request);
          await new Promise((resolve) => (window.release = resolve));
          return answer;
        };""")
    for name in ["earlier", "later"]:
        question.clear()
        question.send_keys(f"select run as {name} from runs", Keys.CONTROL, Keys.ENTER)
    page.wait(lambda: page.texts("#answer th") == ["later"])
    page.wait(lambda: page.browser.execute_script("return Boolean(window.release)"))
    page.browser.execute_script("window.release()")
    time.sleep(0.5)
    assert page.texts("#answer th") == ["later"]


def check_claims_and_sql(page: Served):
    page.one("#tab-claims").click()
    page.wait(lambda: len(page.all("#claims tbody tr")) > 30)
    page.shoot("claims")
    asked = page.answered("/api/claims")
    page.one("#tab-runs").click()
    page.one("#tab-claims").click()
    page.one("#tab-claims").send_keys(Keys.ARROW_RIGHT)
    page.wait(lambda: "runs" in page.texts("#columns summary"))
    question = page.one("#question")
    question.clear()
    question.send_keys("select status, count(*) as n from runs group by status order by status")
    question.send_keys(Keys.CONTROL, Keys.ENTER)
    page.wait(lambda: len(page.all("#answer tbody tr")) > 0)
    assert re.match(r"(1 row|\d+ rows) in ", page.text("#asked"))
    page.shoot("sql")
    check_order(page, question)
    question.clear()
    question.send_keys("select nope from runs")
    page.one("#ask button").click()
    page.wait(lambda: "there is no column 'nope'" in page.text("#asked"))
    assert page.answered("/api/claims") == asked, "claims are judged once by the same runs"
    page.one("#tab-runs").click()


def check_reads(page: Served, process: subprocess.Popen, results: Path):
    """Queries and claims read no record again that has not changed."""
    records = sum(path.stat().st_size for path in results.glob("runs/*/*/run.json"))
    def read() -> int:
        return int(re.search(r"rchar: (\d+)", Path(f"/proc/{process.pid}/io").read_text())[1])
    def read_by(path: str, body: str | None = None) -> int:
        before = read()
        assert ask(page.address, path, body=body)[0] == 200
        return read() - before
    for request in [("/api/sql", "select count(*) as n from runs"), ("/api/claims",)]:
        amounts = [read_by(*request) for _ in range(3)]
        assert min(amounts) < records / 2, (request, amounts, records)


def check_changes(page: Served, results: Path):
    """Runs that appear, are damaged, repaired and removed while the page is open, also while it shows the claims."""
    runs, aside = results / "runs", results / "runs-set-aside"
    record = next(runs.glob("*/*/run.json"))
    runs.rename(aside)
    runs.mkdir()
    page.open(DESKTOP)
    page.wait(lambda: page.count() == [0, 0])
    page.one("#tab-claims").click()
    page.wait(lambda: page.all("#claims tbody tr"))
    asked = page.answered("/api/claims")
    runs.rmdir()
    aside.rename(runs)
    page.wait(lambda: page.answered("/api/claims") > asked)
    page.one("#tab-runs").click()
    everything = page.count()[1]
    assert everything > 0 and page.metric(), "the page was opened before the first run was done"

    whole = record.read_bytes()
    def left_out() -> str:
        return page.text("#left-out:not([hidden])")
    record.write_bytes(whole[:-5])
    page.wait(lambda: str(record) in left_out() and page.count()[1] == everything - 1)
    page.shoot("left-out")
    moved = results / "run-set-aside"
    record.parent.rename(moved)
    page.wait(lambda: left_out() == "")
    assert page.count()[1] == everything - 1
    moved.rename(record.parent)
    page.wait(left_out)

    # An invalid filter and a damaged table keep no run from the page.
    page.filter("nothing=3")
    metrics = record.with_name("metrics.parquet")
    intact = metrics.read_bytes()
    metrics.write_bytes(intact[:-5])
    record.write_bytes(whole)
    page.wait(lambda: str(metrics) in left_out() and page.count() == [everything, everything])
    metrics.write_bytes(intact)
    page.wait(lambda: left_out() == "" and page.count() == [everything, everything])
    page.filter("")
    assert page.column(page.metric())


def check_horizon(page: Served):
    """Runs that predict several samples ahead have charts over the horizon, which show the values of the server."""
    page.open(DESKTOP)
    page.click_row()
    page.wait(lambda: "Over the horizon" in page.texts("#chosen h3"))
    titles = [text for text in page.texts("#chosen h4") if text.endswith(": skill")]
    assert sorted(titles) == ["contact_force: skill", "proprioception: skill"], titles
    name = page.text("#chosen h2")
    run = json.loads(ask(page.address, f"/api/run?run={name}")[1])
    columns = {column["name"]: column["values"] for column in run["horizons"]}
    chosen = [place for place, key in enumerate(zip(columns["model"], columns["modality"], columns["metric"]))
              if key == ("network", "contact_force", "skill")]
    assert [columns["horizon"][place] for place in chosen] == [1, 2, 4] and run["sample_seconds"] == 0.1
    plot = next(box for box in page.all("#chosen .chart") if box.find_element(By.CSS_SELECTOR, "h4").text == titles[0])
    page.browser.execute_script("arguments[0].scrollIntoView({block: 'center'})", plot)
    plot.find_element(By.CSS_SELECTOR, ".plot").send_keys(Keys.END)
    said = plot.find_element(By.CSS_SELECTOR, ".tooltip").text
    assert said.startswith("horizon (s) 0.4"), said
    page.shoot("horizon")
    page.click_row(1)
    page.wait(lambda: page.text("#chosen h2") == "2 runs" and "Over the horizon" in page.texts("#chosen h3"))


def check_fits(page: Served, step: str):
    """Nothing is wider than the phone, and targets are large enough. A checkbox is touched with its row or label."""
    page.shoot(f"phone-{step}")
    wide, small = page.browser.execute_script("""
        const targets = [...document.querySelectorAll("button, select, input, textarea, summary, a[href]")];
        const boxes = targets.map((one) => (one.type === "checkbox" ? one.closest("tr, label") : one))
            .map((one) => [one, one.getBoundingClientRect()]).filter(([, {width}]) => width > 0);
        const small = boxes.filter(([, {width, height}]) => Math.min(width, height) < arguments[0]);
        return [document.documentElement.scrollWidth,
            small.map(([one, {width, height}]) => `${one.outerHTML.slice(0, 120)} ${width} x ${height}`)];""", TARGET)
    assert wide <= PHONE[0], (step, wide)
    assert not small, (step, small[:5])


def check_phone(page: Served):
    page.open(PHONE)
    check_fits(page, "runs")
    Select(page.one("#group")).select_by_visible_text("experiment")
    check_fits(page, "groups")
    Select(page.one("#plotted")).select_by_value(page.metric())
    page.browser.execute_script("document.querySelector('#plot').scrollIntoView()")
    check_fits(page, "plot")
    Select(page.one("#compared")).select_by_index(1)
    page.wait(lambda: page.all("#comparison tbody tr"))
    page.browser.execute_script("document.querySelector('#comparison').scrollIntoView()")
    check_fits(page, "comparison")
    for name in ["compared", "plotted", "group"]:
        Select(page.one(f"#{name}")).select_by_value("")
    for place in range(2):
        page.click_row(place)
    page.wait(lambda: page.text("#chosen h2") == "2 runs" and page.all("#chosen .uplot"))
    page.browser.execute_script("for (const one of document.querySelectorAll('details')) one.open = true")
    page.browser.execute_script("document.querySelector('#chosen').scrollIntoView()")
    check_fits(page, "chosen")
    page.browser.execute_script("document.querySelector('#chosen details').scrollIntoView()")
    check_fits(page, "details")
    page.browser.execute_script("scrollTo(0, 0)")
    page.one("#tab-claims").click()
    page.wait(lambda: page.all("#claims tbody tr"))
    check_fits(page, "claims")
    page.one("#tab-sql").click()
    page.wait(lambda: page.texts("#columns summary"))
    page.one("#ask button").click()
    page.wait(lambda: page.text("#asked").endswith(" s"))
    check_fits(page, "sql")


def check_settings(page: Served):
    """A metric is plotted over a setting, runs are grouped by it, and losses are smoothed, also by an address."""
    page.open(DESKTOP)
    assert page.answered("/api/settings") == 0, "settings are asked for when they are needed"
    page.browser.execute_script("document.querySelector('#over').dispatchEvent(new Event('pointerenter'))")
    key = "training.learning_rate"
    page.wait(lambda: key in page.texts("#over optgroup option") and key in page.texts("#group optgroup option"))
    metric = page.metric()
    Select(page.one("#plotted")).select_by_value(metric)
    Select(page.one("#over")).select_by_value(key)
    runs = {column["name"]: column["values"] for column in json.loads(ask(page.address, "/api/runs")[1])["columns"]}
    rates = [float(re.search(r"learning_rate=([^,]+)", variant)[1]) for variant in runs["variant"]]
    assert sorted(set(rates)) == [0.0001, 0.001, 0.02]
    by_rate = {rate: [value for own, value in zip(rates, runs[metric]) if own == rate] for rate in sorted(set(rates))}
    chart = page.one("#plot .plot")
    assert chart.get_attribute("aria-label").startswith(f"{metric} over {key}: ")

    def said(key: str) -> str:
        chart = page.one("#plot .plot")
        chart.send_keys(key)
        return page.one("#plot .tooltip").text.replace("−", "-")

    # The second and third of the three means; their series is in front.
    page.one("#plot .plot").send_keys(Keys.ESCAPE)
    for keys, (rate, values) in zip([Keys.HOME, Keys.ARROW_RIGHT, Keys.ARROW_RIGHT], by_rate.items()):
        text = said(keys)
        mean = sum(values) / len(values)
        found = re.search(rf"{key} {rate:g}: (-?[\d.]+) ± ", text)
        assert found and abs(float(found[1]) - mean) <= 1e-3 * abs(mean), (text, rate, mean)
    page.shoot("over")
    Select(page.one("#group")).select_by_value(key)
    groups = page.texts("#table tr.group")
    heads = sorted(re.search(r"[\d.]+ \(\d+\)", text)[0] for text in groups)
    assert heads == ["0.0001 (2)", "0.001 (2)", "0.02 (2)"], groups
    assert len(page.texts("#plot .legend button")) == 3, "each group is a series"

    Select(page.one("#group")).select_by_value("")
    page.click_row()
    page.wait(lambda: page.all("#chosen .uplot"))
    script = """
        const range = document.querySelector("#chosen input[type=range]");
        range.value = "0.9";
        range.dispatchEvent(new Event("input"));"""
    page.browser.execute_script(script)
    address = page.browser.current_url
    assert f"over={key}" in address and "smooth=0.9" in address, address
    page.browser.get("about:blank")
    page.browser.get(address)
    page.wait(lambda: page.all("#plot .plot") and page.all("#chosen .uplot"))
    page.wait(lambda: page.one("#plot .plot").get_attribute("aria-label").startswith(f"{metric} over {key}: "))
    name = page.text("#chosen h2")
    run = json.loads(ask(page.address, f"/api/run?run={name}")[1])
    losses = {column["name"]: column["values"] for column in run["losses"]}
    rows = sorted(zip(losses["epoch"], losses["term"], losses["split"], losses["value"]))
    values = [value for _, term, split, value in rows if (term, split) == ("total", "train")]
    weights = [0.9 ** (len(values) - 1 - place) for place in range(len(values))]
    expected = sum(weight * value for weight, value in zip(weights, values)) / sum(weights)
    titles = page.texts("#chosen h4")
    plot = page.all("#chosen .plot")[titles.index("prediction: total")]
    plot.send_keys(Keys.END)
    text = plot.find_element(By.CSS_SELECTOR, ".tooltip").text
    shown = [float(line.rsplit(" ", 1)[1]) for line in text.splitlines() if line.startswith("train: ")]
    assert any(abs(value - expected) <= 1e-3 * expected for value in shown), (text, expected)
    page.shoot("smoothed")


def check_many(page: Served, process: subprocess.Popen):
    """The limits for 10,000 runs: first view in 1 s, filtering in 100 ms, memory below 500 MB."""
    page.open(DESKTOP)
    first = page.open(DESKTOP)
    filters = ["latent>3", "seed=7 status=done", "empty", '"contact_force r2">0.5', ""]
    times = sorted(page.filter(text) for text in filters)
    status = Path(f"/proc/{process.pid}/status").read_text()
    megabytes = int(re.search(r"VmHWM:\s+(\d+)", status)[1]) / 1000
    print(f"first view {first:.2f} s, filter {times[len(times) // 2]:.0f} ms (most {times[-1]:.0f}), "
          f"memory {megabytes:.0f} MB, {page.count()[1]} runs")
    assert first < 1 and times[-1] < 100 and megabytes < 500


def last_epoch(page: Served) -> int:
    """The last epoch in the first chart of the chosen runs; 0 without a chart or a tooltip."""
    if not page.all("#chosen .plot"):
        return 0
    page.one("#chosen .plot").send_keys(Keys.END)
    found = re.match(r"epoch (\d+)", page.one("#chosen .tooltip").text)
    return int(found[1]) if found else 0


class Training:
    """A training that goes on only while the test waits for epochs, so that the page has time to show them."""

    def __init__(self, harness: str, results: str, spec: str):
        command = [harness, "--results", results, "run", spec, "seeds=[77]", "scenarios=[empty]", "training.epochs=600",
                   "training.patience=null"]
        self.process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        self.results = Path(results)

    def epochs(self) -> list[tuple[str, int]]:
        """The epochs that the training has published: tasks and numbers."""
        for path in self.results.glob("runs/*/*seed77-*/.unfinished-epochs.json"):
            try:
                return [(task, epoch["epoch"]) for task, epoch in json.loads(path.read_text())["epochs"]]
            except FileNotFoundError:
                pass
        return []

    def run_until(self, condition):
        """Trains until the published epochs meet the condition."""
        self.process.send_signal(signal.SIGCONT)
        while not condition(self.epochs()):
            assert self.process.poll() is None, "the training ended too early"
            time.sleep(0.005)
        self.process.send_signal(signal.SIGSTOP)

    def finish(self):
        self.process.send_signal(signal.SIGCONT)
        assert self.process.wait(PATIENCE_S) == 0


def check_live(page: Served, harness: str, results: str, spec: str):
    """A run that is started while the page is open appears, its curves grow while it trains, the curves of its second
    task and its metrics follow, and it goes when it is removed."""
    page.open(DESKTOP)
    before = page.count()[1]
    training = Training(harness, results, spec)
    try:
        training.run_until(lambda epochs: epochs)
        page.wait(lambda: page.count()[1] == before + 1)
        page.filter("seed=77")
        assert page.column("status") == ["running"]
        page.click_row()
        page.wait(lambda: last_epoch(page) > 0)
        seen = last_epoch(page)
        training.run_until(lambda epochs: len(epochs) > seen)
        page.wait(lambda: last_epoch(page) > seen)
        page.shoot("growing")
        training.run_until(lambda epochs: any(task == "reconstruction" for task, _ in epochs))
        page.wait(lambda: "reconstruction: total" in page.texts("#chosen h4"))
        assert page.column("status") == ["running"]
        page.shoot("second-task")
        training.finish()
    finally:
        training.process.kill()
    page.wait(lambda: page.column("status") == ["done"])
    page.wait(lambda: "Metrics on test episodes" in page.text("#chosen"))
    page.wait(lambda: len(page.all("#chosen .uplot")) > 0)
    page.shoot("live")
    run = f"{page.column('experiment')[0]}/{page.column('run')[0]}"
    subprocess.run([harness, "--results", results, "rm", run, "--yes"], check=True, stdout=subprocess.DEVNULL)
    page.wait(lambda: page.count() == [0, before])
    page.wait(lambda: page.text("#chosen") == "")


def check_gone(page: Served, process: subprocess.Popen):
    """The page says that the server has ended."""
    process.terminate()
    process.wait(PATIENCE_S)
    page.wait(lambda: page.text("#state") == "the server does not answer; start `harness serve` again")


def check_hostile(page: Served):
    """Names, reasons and settings of runs are shown as texts."""
    page.open(DESKTOP)
    for row in range(min(8, page.count()[1])):
        page.click_row(row)
    time.sleep(2)
    page.one("#tab-claims").click()
    page.one("#tab-sql").click()
    page.one("#question").clear()
    page.one("#question").send_keys("select * from runs", Keys.CONTROL, Keys.ENTER)
    page.wait(lambda: len(page.all("#answer tbody tr")) > 0)
    assert page.browser.execute_script("return window.hostile") is None


def main():
    parser = argparse.ArgumentParser()
    for name in ["harness", "results", "chromium", "driver"]:
        parser.add_argument(name)
    parser.add_argument("--hostile", action="store_true")
    parser.add_argument("--many", action="store_true")
    parser.add_argument("--horizon", action="store_true")
    parser.add_argument("--settings", action="store_true")
    parser.add_argument("--live")
    parser.add_argument("--screenshots", type=Path)
    chosen = parser.parse_args()
    command = [chosen.harness, "--results", chosen.results, "serve", "--port", "0"]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    try:
        address = process.stdout.readline().split()[0]
        with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile:
            browser = open_browser(chosen.chromium, chosen.driver, profile)
            try:
                page = Served(browser, address, chosen.screenshots)
                if chosen.hostile:
                    check_hostile(page)
                elif chosen.many:
                    check_many(page, process)
                elif chosen.horizon:
                    check_horizon(page)
                elif chosen.settings:
                    check_settings(page)
                else:
                    check_guard(address)
                    check_runs(page)
                    check_comparison(page, chosen.harness, chosen.results)
                    page.open(DESKTOP)
                    check_chosen(page)
                    check_claims_and_sql(page)
                    check_reads(page, process, Path(chosen.results))
                    check_changes(page, Path(chosen.results))
                    check_phone(page)
                    if chosen.live:
                        check_live(page, chosen.harness, chosen.results, chosen.live)
                page.check_quiet()
                check_gone(page, process)
            finally:
                browser.quit()
    finally:
        process.terminate()
        assert process.wait(PATIENCE_S) == 0, "SIGTERM must end the server well"
    print("the page works")


if __name__ == "__main__":
    main()
