"""Golden lines of the text formats, as their documentation and real tools show them."""

from __future__ import annotations

import datetime
from pathlib import Path

import pytest

from firmware_bridge.frames import EXTENDED, Frames
from firmware_bridge.sources import LogError, open_log

VECTOR = """date Sam Sep 30 03:06:13.191 pm 2017
base hex  timestamps absolute
internal events logged
// version 9.0.0
Begin Triggerblock Sam Sep 30 03:06:13.191 pm 2017
   0.000000 Start of measurement
   0.015991 CAN 1 Status:chip status error passive - TxErr: 132 RxErr: 0
   1.015991 1  Statistic: D 0 R 0 XD 0 XR 0 E 0 O 0 B 0.00%
   2.501010 1 ErrorFrame ECC: 10100010
   3.098426 1  18EBFF00x       Rx   d 8 01 A0 0F A6 60 3B D1 40  Length = 273910 BitCount = 141 ID = 1x
   3.297743 1  J1939TP FEE3p        6    0  0   -   Rx   d 23 A0 0F A6 60 3B D1 40 1F DE 80 25
  17.876708 2  6F9             Tx   d 3 05 0C ff
  17.876709 2  6F9             Tx   d D 01 02 03 04 05 06 07 08
  17.876710 2  6F9             Rx   d 0
  18.000000 1  6F9             Rx   r 8
  18.100000 CANFD   3 Rx        167x  VehicleOperatingModes            1 0 3  3 73 80 0f   102187  133   323000 e000fb6c 46500250 4b140250 20011736 2001040d
  18.150000 CANFD   3 Rx        167x  VehicleOperatingModes            0 0 3  3 73 80 0f   102187  133   200000 e000fb6c 46500250 4b140250 20011736 2001040d
  18.160000 CANFD   3 Rx        167                                   0 0 1  1 73
  18.200000 CANFD   3 Tx        716                                   1 0 9 12 64 12 3b 36 01 7b 0a 20 20 20 20 22        0    0     3000        0        0        0        0        0
  18.300000 CANFD   3 Rx ErrorFrame  more
  18.400000 1  900             Rx   d 1 00
  18.400000 1  6F9             Rx   d 2 00
  18.400000 1  6F9             Rx   d 1 00 00
  18.400000 1  6F9             Rx   d 1 0
  18.4q0000 1  6F9             Rx   d 1 00
End TriggerBlock
"""  # noqa: E501


def read(folder: Path, name: str, text: str) -> Frames:
    path = folder / name
    path.write_text(text, newline="")
    return open_log(path)


def local_us(*date: int) -> int:
    return round(datetime.datetime(*date).timestamp() * 1e6)  # type: ignore[arg-type]


@pytest.mark.parametrize("ending", ["\n", "\r\n"])
def test_asc_as_vector_writes_it(tmp_path: Path, ending: str) -> None:
    frames = read(tmp_path, "t.asc", VECTOR.replace("\n", ending))
    start_us = local_us(2017, 9, 30, 15, 6, 13, 191_000)
    assert (frames.t_us - start_us).tolist() == [
        3_098_426, 17_876_708, 17_876_709, 17_876_710, 18_100_000, 18_150_000, 18_160_000,
        18_200_000,
    ]  # fmt: skip
    assert frames.channel.tolist() == [0, 1, 1, 1, 2, 2, 2, 2]
    assert frames.can_id.tolist() == [
        0x18EBFF00 | EXTENDED, 0x6F9, 0x6F9, 0x6F9, 0x167 | EXTENDED, 0x167 | EXTENDED, 0x167,
        0x716,
    ]  # fmt: skip
    assert frames.length.tolist() == [8, 3, 8, 0, 3, 3, 1, 12]
    assert frames.data[0].tobytes().hex() == "01a00fa6603bd140" + 16 * "0"
    assert frames.data[5, :8].tobytes().hex() == "73800f0000000000"
    assert frames.data[7].tobytes().hex() == "64123b36017b0a2020202022" + 8 * "0"
    assert frames.refused == {
        "other_event": 3, "error_frame": 2, "remote_frame": 1, "bad_line": 5,
    }  # fmt: skip


def test_asc_in_decimal_with_relative_stamps(tmp_path: Path) -> None:
    text = (
        "date Don Mär 2 10:00:00.5 2023\nbase dec  timestamps relative\nno internal events logged\n"
        "0.5000 1  1785  Rx d 2 0 255\n"
        "0.2500 1  Statistic: D 0\n"
        "0.2500 1  418119424x  Rx d 1 07  Length = 1 BitCount = 2 ID = 3\n"
        "0.1 1  1  Rx d 1 256\n"
    )
    frames = read(tmp_path, "t.asc", text)
    assert (frames.t_us - local_us(2023, 3, 2, 10, 0, 0, 5000)).tolist() == [500_000, 1_000_000]
    assert frames.can_id.tolist() == [1785, 418119424 | EXTENDED]
    assert frames.data[0, :2].tolist() == [0, 255]
    assert frames.refused == {"other_event": 1, "bad_line": 1}


@pytest.mark.parametrize(("base", "value"), [("hex", 0x10), ("dec", 10)])
def test_asc_with_a_damaged_header_is_read_in_the_base_that_fits(
    tmp_path: Path, base: str, value: int
) -> None:
    one = {"hex": "10 fe", "dec": "10 254"}[base]
    text = f"bXse {base}  timestXmps relativX\n" + f"0.5 1  100  Rx d 2 {one}\n" * 3
    frames = read(tmp_path, "t.asc", text)
    assert frames.data[:, :2].tolist() == [[value, 254]] * 3
    assert frames.t_us.tolist() == [500_000, 1_000_000, 1_500_000]


def test_asc_that_ends_between_two_lines_is_truncated(tmp_path: Path) -> None:
    frames = read(tmp_path, "t.asc", VECTOR[: VECTOR.index("End")])
    assert frames.refused["truncated"] == 1
    damaged = read(tmp_path, "t.asc", VECTOR.replace("Sep 30", "Sop 30"))
    assert damaged.refused["bad_date"] == 1
    assert damaged.t_us[0] == 3_098_426


def test_asc_with_names_for_identifiers_is_refused(tmp_path: Path) -> None:
    with pytest.raises(LogError, match="log identifiers as numbers"):
        read(tmp_path, "t.asc", "base hex  timestamps absolute\n1.0 1  Engine  Rx d 1 00\n")


TRC = {
    "1.0": ";##########################################\n;   C:\\t.trc\n"
    "     1)     1841      0001 8 00 00 00 00 00 00 00 00 \n"
    "     2)     1842      0008 4 ERROR 00 19 08 08\n"
    "     3)     1843  FFFFFFFF 4 00 00 00 04 -- -- -- -- BUSLIGHT\n"
    "     4)     1844      0100 3 RTR\n"
    "     5)     1845  18FF0001 2 0A fF\n",
    "1.1": ";$FILEVERSION=1.1\n;$STARTTIME=44548.6028595139\n"
    "     1)      1841.0  Tx         0001  8  00 00 00 00 00 00 00 00 \n"
    "     2)      1842.0  Warng  FFFFFFFF  4  00 00 00 08  BUSHEAVY \n"
    "     3)      1843.0  Error      0008  4  00 19 08 08\n"
    "     4)      1844.0  Rx         0100  3  RTR\n"
    "     5)      1845.0  Rx     18FF0001  2  0A FF \n",
    "1.3": ";$FILEVERSION=1.3\n;$STARTTIME=44548.6028595139\n"
    "     1)      1841.0 1  Tx        0001 -  8    00 00 00 00 00 00 00 00\n"
    "     2)      1842.0 1  Warng FFFFFFFF -  4    00 00 00 08  BUSHEAVY\n"
    "     3)      1843.0 1  Error     0008 -  4    00 19 08 08\n"
    "     4)      1844.0 1  Rx        0100 -  3    RTR\n"
    "     5)      1845.0 1  Rx    18FF0001 -  2    0A FF\n",
    "2.0": ";$FILEVERSION=2.0\n;$STARTTIME=44548.6028595139\n;$COLUMNS=N,O,T,I,d,l,D\n"
    "      1      1841.000 DT     0001 Tx 8  00 00 00 00 00 00 00 00\n"
    "      2      1842.000 ST          Rx    00 00 00 08\n"
    "      3      1843.000 ER          Rx 5  04 00 02 00 00\n"
    "      4      1844.000 RR     0100 Rx 3\n"
    "      5      1845.000 DT 18FF0001 Rx 2  0A FF\n",
    "2.1": ";$FILEVERSION=2.1\n;$STARTTIME=44548.6028595139\n;$COLUMNS=N,O,T,B,I,d,R,L,D\n"
    "      1      1841.000 DT 1      0001 Tx -  8    00 00 00 00 00 00 00 00\n"
    "      2      1842.000 ST 1      -    Rx -  4    00 00 00 08\n"
    "      3      1843.000 ER 1      -    Rx -  5    04 00 02 00 00\n"
    "      4      1844.000 RR 1      0100 Rx -  3\n"
    "      5      1845.000 DT 1  18FF0001 Rx -  2    0A FF\n",
}


@pytest.mark.parametrize("version", TRC)
def test_trc_of_all_versions(tmp_path: Path, version: str) -> None:
    frames = read(tmp_path, "t.trc", TRC[version].replace("\n", "\r\n"))
    # 18.12.2021 14:28:07.062 by the header's comment; the stamp has 10 decimals of a day
    start_us = 0 if version == "1.0" else 1_639_837_687_062_001
    assert (frames.t_us - start_us).tolist() == [1_841_000, 1_845_000]
    assert frames.can_id.tolist() == [1, 0x18FF0001 | EXTENDED]
    assert frames.channel.tolist() == [0, 0]
    assert frames.length.tolist() == [8, 2]
    assert frames.data[1].tobytes().hex() == "0aff000000000000"
    assert frames.refused == {"error_frame": 1, "other_event": 1, "remote_frame": 1}


def test_trc_with_a_damaged_header_is_read_by_the_columns_that_fit(tmp_path: Path) -> None:
    text = TRC["2.1"].replace("B,I", "B,i").replace("2.1", "7.1").replace("44548", "44x48")
    frames = read(tmp_path, "t.trc", text)
    assert frames.can_id.tolist() == [1, 0x18FF0001 | EXTENDED]
    assert frames.t_us.tolist() == [1_841_000, 1_845_000]
    assert frames.refused["bad_date"] == 1


def test_trc_counts_what_does_not_agree(tmp_path: Path) -> None:
    lines = [
        "1) 1.0 Rx 0001 2 00",
        "1) 1.0 Rx 0001 2 00 00 00",
        "1) 1.0 Rx 0801 1 00",
        "1) 1.0 Rx 001 1 00",
        "1) 1.0 Qx 0001 1 00",
        "1) 1.0 Rx 0001 1 0g",
        "1) 1.0 Rx 0001 12 00 00 00 00 00 00 00 00 00 00 00 00",
        "1) 2.0 Rx 0001 1 00",
        *(f"1) 2.0 {kind} 0001 1 00" for kind in ("FD", "FB", "FE", "BI")),
    ]
    head = ";$FILEVERSION=1.1\n;$STARTTIME=0\n"
    frames = read(tmp_path, "t.trc", head + "\n".join(lines) + "\n")
    assert len(frames) == 1
    assert frames.refused == {"bad_line": 6, "fd_frame": 5}


def test_csv_as_python_can_writes_it(tmp_path: Path) -> None:
    text = (
        "timestamp,arbitration_id,extended,remote,error,dlc,data\n"
        "0.0,0x0,0,0,0,0,\n"
        "1.25e-05,0x7ff,0,0,0,1,/w==\n"
        "1483389946.197,0x00dadada,1,0,0,6,WzQyLCA5\n"
        "1483389946.2,0x1,0,1,0,8,\n"
        "1483389946.2,0x1,0,0,1,8,AAAAAAAAAAA=\n"
        "1483389946.2,0x1,0,0,0,12,AAAAAAAAAAAAAAAA\n"
        "1483389946.2,0x800,0,0,0,0,\n"
        "1483389946.2,0x1,0,0,0,1,/x==\n"
        "1483389946.2,0x1,0,0,0,2,/w==\n"
        "1483389946.2,0x1,0,2,0,1,/w==\n"
    )
    frames = read(tmp_path, "t.csv", text)
    assert frames.t_us.tolist() == [0, 13, 1_483_389_946_197_000, 1_483_389_946_200_000]
    assert frames.can_id.tolist() == [0, 0x7FF, 0xDADADA | EXTENDED, 1]
    assert frames.length.tolist() == [0, 1, 6, 12]
    assert frames.data[2, :8].tobytes() == b"[42, 9\0\0"
    assert frames.refused == {"remote_frame": 1, "error_frame": 1, "bad_line": 4}


def test_a_lone_stray_stamp_is_refused_a_step_of_the_clock_is_not(tmp_path: Path) -> None:
    seconds = [9.0, 1.0, 1.1, 5.0, 1.2, 1.3, 0.5, 1.4, 1.35, 7.0, 7.1, 2.0, 2.1, 1.0]
    text = "".join(f"({t}) can0 120#00\n" for t in seconds)
    frames = read(tmp_path, "t.log", text)
    kept = [1.0, 1.1, 1.2, 1.3, 1.4, 1.35, 7.0, 7.1, 8.1, 8.2]  # the step back is a gap of 1 s
    assert (frames.t_us * 1e-6).tolist() == pytest.approx(kept)
    assert frames.refused == {"stray_stamp": 4, "clock_step": 1}


def test_a_header_whose_base_cannot_be_read_is_counted(tmp_path: Path) -> None:
    text = "date Sun Sep 13 12:26:40.0 2020\nbase {}  timestamps absolute\n"
    text += "".join(f" 0.{k:03d}000 1  120  Rx   d 8 EC A0 38 05 00 10 8D 02\n" for k in range(99))
    for base, refused in (("hex", {}), ("hdx", {"bad_line": 1})):
        frames = read(tmp_path, "t.asc", text.format(base))
        assert len(frames) == 99 and frames.refused == refused


GVRET = {  # SavvyCAN since 2016, before, and loggers that know one bus
    "Time Stamp,ID,Extended,Dir,Bus,LEN,D1,D2,D3,D4,D5,D6,D7,D8": "{t},{i},{x},Rx,{b},{d}",
    "Time Stamp,ID,Extended,Bus,LEN,D1,D2,D3,D4,D5,D6,D7,D8": "{t},{i},{x},{b},{d}",
    "Time Stamp,ID,Extended,LEN,D1,D2,D3,D4,D5,D6,D7,D8": "{t},{i},{x},{d}",
}


@pytest.mark.parametrize("head", GVRET)
@pytest.mark.parametrize("ending", ["\n", "\r\n"])
def test_csv_as_savvycan_writes_it(tmp_path: Path, head: str, ending: str) -> None:
    form = GVRET[head].format
    lines = [
        form(t=39747828, i="000005EB", x="false", b=0, d="8,E8,45,85,4B,4A,28,36,69,"),
        form(t=39747829, i="1F334455", x="true", b=2, d="2,0A,0B,00,00,00,00,00,00,"),
        form(t=39747830, i="18FF0001", x="false", b=1, d="0"),
        form(t=39747831, i="123", x="False", b=1, d="1,5"),
        form(t=39747832, i="123", x="false", b=0, d="12,01,02,03,04,05,06,07,08,"),
        form(t=39747833, i="123", x="false", b=0, d="2,01"),
        form(t=39747833, i="123", x="false", b=0, d="2,01,0g"),
        form(t=39747833, i="12q", x="false", b=0, d="1,01"),
        form(t=39747833, i="123", x="maybe", b=0, d="1,01"),
        form(t=3.5, i="123", x="false", b=0, d="1,01"),
        form(t=1_700_000_039_747_834, i="7FF", x="false", b=0, d="1,FF"),
    ]
    frames = read(tmp_path, "t.csv", ending.join([head, *lines, ""]))
    assert frames.t_us.tolist()[:4] == [39747828, 39747829, 39747830, 39747831]
    assert frames.t_us[4] == 1_700_000_039_747_834
    assert frames.can_id.tolist() == [
        0x5EB, 0x1F334455 | EXTENDED, 0x18FF0001 | EXTENDED, 0x123, 0x7FF,
    ]  # fmt: skip
    assert frames.channel.tolist() == ([0, 2, 1, 1, 0] if "Bus" in head else [0] * 5)
    assert frames.length.tolist() == [8, 2, 0, 1, 1]
    assert frames.data[0].tobytes().hex() == "e845854b4a283669"
    assert frames.data[1].tobytes().hex() == "0a0b000000000000"
    assert frames.data[3, 0] == 5
    assert frames.refused == {"fd_frame": 1, "bad_line": 5}
